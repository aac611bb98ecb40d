import os
from collections.abc import Mapping, Sequence
from types import TracebackType
from typing import Any

from typing_extensions import Self

import numpy as np
from numpy.typing import ArrayLike

from .boxes import LogBoxes

Stamp = int | np.integer[Any] | np.datetime64

def agent(
    name: str,
    kind: str,
    footprint: ArrayLike | None = None,
    sensor: str = "",
    sensor_position: ArrayLike | None = None,
) -> dict[str, Any]: ...
def view(
    position: ArrayLike, quaternion: ArrayLike, focal: ArrayLike, center: ArrayLike, size: ArrayLike, margin: float = 0
) -> dict[str, Any]: ...

class LogWriter:
    def __init__(
        self,
        path: str | os.PathLike[str],
        agents: Sequence[Mapping[str, Any]],
        source: str,
        protocol: str = "default",
        key_frames: str = "all",
        map_frame: str = "map",
        force: bool = False,
        clock: str = "1970",
        map_origin: ArrayLike | None = None,
    ) -> None: ...
    def __enter__(self) -> Self: ...
    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...
    def pose(
        self,
        agent: str,
        stamp: Stamp,
        position: ArrayLike,
        quaternion: ArrayLike,
        covariance: ArrayLike | None = None,
        ready: Stamp | None = None,
        truth: bool = False,
    ) -> None: ...
    def sweep(
        self,
        agent: str,
        stamp: Stamp,
        points: ArrayLike,
        intensity: ArrayLike = 0,
        time: ArrayLike = 0,
        ring: ArrayLike = 0,
        ready: Stamp | None = None,
        intensity_max: float | None = None,
    ) -> None: ...
    def detections(self, agent: str, stamp: Stamp, boxes: LogBoxes, ready: Stamp | None = None) -> None: ...
    def truth(
        self,
        agent: str,
        stamp: Stamp,
        boxes: LogBoxes,
        points: ArrayLike | None = None,
        key: bool = True,
        ready: Stamp | None = None,
        views: Sequence[Mapping[str, Any]] = (),
    ) -> None: ...
    def own_labels(
        self,
        agent: str,
        stamp: Stamp,
        boxes: LogBoxes,
        points: ArrayLike | None = None,
        key: bool = True,
        ready: Stamp | None = None,
        views: Sequence[Mapping[str, Any]] = (),
    ) -> None: ...
    def mount(self, agent: str, stream: str, position: ArrayLike, quaternion: ArrayLike = (0, 0, 0, 1)) -> None: ...
    def imu(
        self,
        agent: str,
        stamp: Stamp,
        angular_rate: ArrayLike,
        acceleration: ArrayLike,
        variances: Sequence[float] | None = None,
        ready: Stamp | None = None,
    ) -> None: ...
    def fix(
        self,
        agent: str,
        stamp: Stamp,
        place: ArrayLike | None,
        covariance: ArrayLike | None = None,
        quality: str = "single",
        ready: Stamp | None = None,
    ) -> None: ...
    def wheels(
        self, agent: str, stamp: Stamp, speed: float, speed_variance: float | None = None, ready: Stamp | None = None
    ) -> None: ...
    def close(self) -> None: ...
