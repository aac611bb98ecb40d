"""Frames as a `Dataset` of PyTorch, which this module imports.

    from torch.utils.data import DataLoader
    from realo.torch import Dataset, collate

    for frames in DataLoader(Dataset("my.mcap", ego="car"), batch_size=4, num_workers=2, collate_fn=collate):
        ...
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from .frames import Frame, Frames
from .log import Log, Path

try:
    import torch
    from torch.utils.data import Dataset as _Dataset
except ImportError as error:
    raise ImportError("realo.torch needs PyTorch: `python -m pip install torch`; realo.Frames is the same without it") from error


class Dataset(_Dataset[Any]):  # type: ignore[misc, unused-ignore]
    """The frames of an ego in a log as dicts of tensors; arguments as of `Frames`.

    By default a sample has `seq` and `stamp` (int), `ego`; `points`: by agent, `[n, 4]` float32, x, y, z, intensity in 0..1, in the
    agent's body frame; `poses`: by agent, `[4, 4]` float64, map from body; `ego_from`: by agent, `[4, 4]` float64, what brings its points to the ego's
    body frame; `boxes`: `[n, 7]` float32, x, y, z, length, width, height, yaw, in the ego's body frame; `classes`: `[n]` int64, places in
    `class_names`; `track`: `[n]` int64, -1 where there is none.

    class_names: classes that count, in order; others are left out. None: all that are in the truth, sorted. transform: what makes a sample
    of a `Frame`, in place of this. Safe with `num_workers`: each worker opens the file itself.
    """

    def __init__(
        self,
        log: Path | Log,
        ego: str,
        agents: Sequence[str] | None = None,
        *,
        class_names: Sequence[str] | None = None,
        transform: Callable[[Frame], Any] | None = None,
        **options: Any,
    ) -> None:
        self.frames = Frames(log, ego, agents, **options)
        found = {str(name) for truth in self.frames._truth.values() for name in truth.boxes.classes}
        self.class_names = sorted(found) if class_names is None else list(class_names)
        self.transform = transform

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, number: int) -> Any:
        frame: Frame = self.frames[number]
        return self.sample(frame) if self.transform is None else self.transform(frame)

    def sample(self, frame: Frame) -> dict[str, Any]:
        """The sample of a frame."""
        places = {name: at for at, name in enumerate(self.class_names)}
        boxes = frame.boxes[np.array([name in places for name in frame.boxes.classes], bool)]
        track = [-1 if one is None or one >= 2**63 else int(one) for one in boxes.track]
        return {
            "ego": frame.ego,
            "seq": frame.seq,
            "stamp": frame.stamp,
            "points": {name: _points(sweep) for name, sweep in frame.sweeps.items()},
            "poses": {name: torch.from_numpy(pose.copy()) for name, pose in frame.poses.items()},
            "ego_from": {name: torch.from_numpy(frame.ego_from(name)) for name in frame.poses},
            "boxes": torch.from_numpy(boxes.values.astype(np.float32)),
            "classes": torch.tensor([places[name] for name in boxes.classes], dtype=torch.int64),
            "track": torch.tensor(track, dtype=torch.int64),
        }


def _points(sweep: Any) -> torch.Tensor:
    intensity = sweep.intensity.astype(np.float32)[:, None] / 255
    return torch.from_numpy(np.concatenate([sweep.points, intensity], axis=1))


def collate(samples: list[Any]) -> list[Any]:
    """A batch as the list of its samples: frames differ in points, agents and boxes."""
    return samples
