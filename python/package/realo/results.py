"""Results of runs."""

import json
import os
import shutil
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any

import pyarrow as pa

from . import _check, _realo, _tables
from .log import Path

if TYPE_CHECKING:
    import pandas as pd

ORDERS = ("sorted", "v2x-real")
ACCURACIES = ("accuracy", "accuracy_seen", "accuracy_processed")


class Run:
    """What a run, or an evaluation, gave: `print(run)` is the table, `run.result` is `result.json` (docs/reference/results.md)."""

    def __init__(self, files: _realo.RunFiles, name: str) -> None:
        self._files, self.name = files, name

    def __repr__(self) -> str:
        return f"Run({self.name!r}, mAP={self.mean_ap() if self.result['accuracy'] else None})"

    def __str__(self) -> str:
        return self.table()

    @cached_property
    def result(self) -> dict[str, Any]:
        """`result.json`."""
        found: dict[str, Any] = json.loads(self._files.result())
        return found

    @cached_property
    def timing(self) -> dict[str, Any]:
        """`timing.json`."""
        found: dict[str, Any] = json.loads(self._files.timing())
        return found

    @cached_property
    def samples(self) -> dict[str, Any]:
        """`evaluation.json`: what the scores are made from."""
        found: dict[str, Any] = json.loads(self._files.samples())
        return found

    def _accuracy(self, order: str, against: str) -> dict[str, Any]:
        _check.one_of("Run", "order", order, ORDERS)
        _check.one_of("Run", "against", against, ACCURACIES)
        found: dict[str, Any] | None = self.result[against]
        if found is None:
            raise ValueError(f"`run`: expected a run with scores, found {self.name}, which was not evaluated")
        ordered: dict[str, Any] = found[order]
        return ordered

    def mean_ap(self, order: str = "sorted", against: str = "accuracy") -> dict[float, float | None]:
        """mAP by IoU. None where a class has no object. order: sorted or v2x-real; against: accuracy (all objects), accuracy_seen (those
        that the ego alone sees), accuracy_processed (frames with boxes)."""
        return {float(iou): value for iou, value in self._accuracy(order, against)["mAP"].items()}

    def ap(self, order: str = "sorted", against: str = "accuracy") -> dict[str, dict[float, float | None]]:
        """AP by class and IoU; arguments as of `mean_ap`."""
        by_class = self._accuracy(order, against)["AP"].items()
        return {name: {float(iou): value for iou, value in ious.items()} for name, ious in by_class}

    def table(self, format: str = "table", full: bool = False, width: int | None = None) -> str:
        """As `realo compare` prints it. format: table, md, csv, latex or json."""
        return compare({self.name: self}, format, full, width)

    def to_arrow(self) -> pa.Table:
        """A row for each accuracy, order, class (`mAP`: their mean) and IoU: AP, true and false detections, objects."""
        rows: list[dict[str, Any]] = []
        for against in [name for name in ACCURACIES if self.result[name]]:
            for order in ORDERS:
                found = self._accuracy(order, against)
                at = {"against": against, "order": order}
                for name, ious in found["AP"].items():
                    counts = found["counts"][name]
                    rows += [{**at, "class": name, "iou": float(iou), "AP": ap, **_counts(counts[iou])} for iou, ap in ious.items()]
                rows += [{**at, "class": "mAP", "iou": float(iou), "AP": ap, **_counts({})} for iou, ap in found["mAP"].items()]
        texts = [(name, pa.string()) for name in ("against", "order", "class")]
        numbers = [("iou", pa.float64()), ("AP", pa.float64())]
        counts = [(name, pa.uint64()) for name in ("true", "false", "objects")]
        return pa.Table.from_pylist(rows, pa.schema([*texts, *numbers, *counts]))

    def to_dataframe(self) -> "pd.DataFrame":
        """`to_arrow` as a DataFrame of pandas."""
        return _tables.to_dataframe(self.to_arrow())

    def frames(self) -> pa.Table:
        """A row for each scored frame, class and IoU: true and false detections, objects."""
        return pa.table(self._files.frames())

    def detections(self) -> pa.Table:
        """The detections that counted, with their super-classes, m and rad, rounded to a micrometre."""
        return pa.table(self._files.scored(True))

    def objects(self) -> pa.Table:
        """The objects that counted, as `detections`."""
        return pa.table(self._files.scored(False))

    def write(self, folder: Path) -> None:
        """Writes the folder of the run, which `realo compare` and `read_run` read. Nothing of somebody else is overwritten."""
        os.makedirs(folder, exist_ok=True)
        self._files.write(os.fspath(folder))


def _counts(counts: Mapping[str, int]) -> dict[str, int | None]:
    return {"true": counts.get("true"), "false": counts.get("false"), "objects": counts.get("total")}


def read_run(folder: Path) -> Run:
    """Reads the folder of a complete run, as `realo run --out` and `Run.write` write it."""
    folder = os.fspath(folder)
    return Run(_realo.RunFiles.read(folder), os.path.basename(os.path.normpath(folder)))


def compare(runs: Mapping[str, Run], format: str = "table", full: bool = False, width: int | None = None) -> str:
    """Runs side by side, by their names, as `realo compare` prints them."""
    _check.one_of("compare", "format", format, ["table", "md", "csv", "latex", "json"])
    if not runs:
        _check.refuse("compare", "runs", "one run or more, by names", "none", "realo.evaluate and realo.read_run give runs")
    columns = max(width or shutil.get_terminal_size().columns, 40)
    return _realo.shown(list(runs), [run._files for run in runs.values()], format, full, columns)


def pool(runs: Sequence[Run], name: str = "pooled") -> Run:
    """Several runs of the same settings as one: scores come from the frames of all, not from means of scores."""
    return Run(_realo.pool([run._files for run in runs]), name)
