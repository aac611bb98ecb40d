"""Messages as Arrow rows: the header's fields, then the payload's columns as lists."""

import copy
from dataclasses import dataclass, field

import pyarrow as pa

_F64, _I64, _TEXT = pa.list_(pa.float64()), pa.list_(pa.int64()), pa.list_(pa.string())
_BOXES = {
    **dict.fromkeys(("x", "y", "z", "length", "width", "height", "yaw"), _F64),
    "class": _TEXT,
    "score": pa.list_(pa.float32()),
    "track": pa.list_(pa.uint64()),
    "velocity": pa.list_(pa.list_(pa.float64(), 3)),
    "covariance": pa.list_(pa.list_(pa.float64(), 9)),
}
#: The columns of each payload; `Selection` has `entries` besides, whole messages.
PAYLOADS = {
    "PointCloud": {
        **dict.fromkeys(("x", "y", "z"), pa.list_(pa.float32())),
        "intensity": pa.list_(pa.uint8()),
        "time": pa.list_(pa.int32()),
        "ring": pa.list_(pa.uint16()),
    },
    "EgoState": {
        **dict.fromkeys(("map_from_body", "covariance", "velocity", "angular_rate"), _F64),
        "status": pa.string(),
    },
    "FeatureMap": {
        **dict.fromkeys(("rows", "columns", "channels"), pa.uint32()),
        "cell": pa.float64(),
        "origin": _F64,
        "dtype": pa.string(),
        "data": pa.binary(),
        "model": pa.string(),
    },
    "Packet": {"codec": _TEXT, "bytes": pa.binary()},
    "Selection": {"query": pa.uint64()},
    "Report": {"topic": pa.string(), "json": pa.string()},
    "Boxes": _BOXES,
    "GroundTruth": {
        **_BOXES,
        "agents": _TEXT,
        "points": pa.list_(pa.uint32()),
        "ego_footprint": _F64,
        "key": pa.bool_(),
    },
}
_HEADER = {
    **dict.fromkeys(("run", "agent", "kind"), pa.string()),
    **dict.fromkeys(("seq", "hop"), pa.uint64()),
    "clock_origins": _I64,
    "clock_rate": _F64,
    **dict.fromkeys(("stamp", "ready"), pa.int64()),
    "frame": pa.string(),
    **dict.fromkeys(("pose", "pose_covariance"), _F64),
    "to": pa.string(),
    "trace_node": _TEXT,
    **dict.fromkeys(("trace_input", "trace_start", "trace_done", "trace_ready"), _I64),
}


@dataclass
class Header:
    """What a message says of itself; times in ns.

    pose: `x y z qx qy qz qw` of `frame` in `map` at `stamp`, empty if unknown; clock_origins: wall and log origin of a
    realtime run, else empty; to: the agent that a link delivered it to, else empty.
    """

    run: str = ""
    agent: str = ""
    kind: str = "report"
    seq: int = 0
    hop: int = 0
    clock_origins: list = field(default_factory=list)
    clock_rate: list = field(default_factory=list)
    stamp: int = 0
    ready: int = 0
    frame: str = "/body"
    pose: list = field(default_factory=list)
    pose_covariance: list = field(default_factory=list)
    to: str = ""
    trace_node: list = field(default_factory=list)
    trace_input: list = field(default_factory=list)
    trace_start: list = field(default_factory=list)
    trace_done: list = field(default_factory=list)
    trace_ready: list = field(default_factory=list)

    def copy(self, **changes):
        """A header of its own with some fields changed."""
        header = copy.copy(self)
        for name in ("trace_node", "trace_input", "trace_start", "trace_done", "trace_ready"):
            setattr(header, name, list(getattr(self, name)))
        for name, value in changes.items():
            if name not in _HEADER:
                raise ValueError(f"expected a field of the header, one of {', '.join(_HEADER)}, found `{name}`")
            setattr(header, name, value)
        return header

    def __str__(self):
        return f"{self.kind} of {self.agent}, seq {self.seq}, stamp {self.stamp} ns"


@dataclass
class Message:
    """A header, the name of the payload's type, and its columns by name: Arrow arrays (`to_numpy()`), or plain values
    where the column holds one. A Selection has `entries`, a list of messages."""

    header: Header
    type: str
    payload: dict

    @staticmethod
    def read(row: pa.StructArray):
        """The message of a struct array of one row. Raises `ValueError` for anything else."""
        if not pa.types.is_struct(row.type) or len(row) != 1:
            raise ValueError(f"a message is a struct array of 1 row, found {len(row)} of {row.type}")
        columns = {row.type.field(i).name: column for i, column in enumerate(row.flatten())}
        kind = _value(columns, "payload", pa.string())
        if kind not in PAYLOADS:
            raise ValueError(f"field `payload`: expected one of {', '.join(PAYLOADS)}, found `{kind}`")
        header = {name: _value(columns, name, as_) for name, as_ in _HEADER.items()}
        header = Header(**{name: v.to_pylist() if isinstance(v, pa.Array) else v for name, v in header.items()})
        payload = {name: _value(columns, name, as_) for name, as_ in PAYLOADS[kind].items()}
        if kind == "Selection":
            payload["entries"] = []
            while (entry := columns.get(f"entry_{len(payload['entries'])}")) is not None:
                payload["entries"].append(Message.read(entry))
        return Message(header, kind, payload)

    def write(self) -> pa.StructArray:
        """The message as a struct array of one row. Raises `ValueError` for columns that are missing or do not fit."""
        arrays, fields = [pa.array([self.type])], [pa.field("payload", pa.string())]
        for name, as_, value in self._cells():
            arrays.append(_cell(name, as_, value))
            fields.append(pa.field(name, as_))
        for i, entry in enumerate(self.payload.get("entries", []) if self.type == "Selection" else []):
            arrays.append(entry.write())
            fields.append(pa.field(f"entry_{i}", arrays[-1].type))
        return pa.StructArray.from_arrays(arrays, fields=fields)

    def _cells(self):
        for name, as_ in _HEADER.items():
            yield name, as_, getattr(self.header, name)
        for name, as_ in PAYLOADS[self.type].items():
            if name not in self.payload:
                raise ValueError(f"a {self.type} needs the column `{name}`")
            yield name, as_, self.payload[name]


def _value(columns, name, expected):
    column = columns.get(name)
    if column is None or not column.type.equals(expected) and not _alike(column.type, expected):
        found = "nothing" if column is None else column.type
        raise ValueError(f"field `{name}`: expected {expected}, found {found}")
    if not column[0].is_valid:
        raise ValueError(f"field `{name}`: is null")
    return column[0].values if pa.types.is_list(expected) else column[0].as_py()


def _alike(found, expected):
    """Whether two lists differ in nothing but the name of their items."""
    nested = pa.types.is_list(found) and pa.types.is_list(expected)
    nested |= pa.types.is_fixed_size_list(found) and pa.types.is_fixed_size_list(expected)
    return nested and (found.value_type == expected.value_type or _alike(found.value_type, expected.value_type))


def _cell(name, as_, value):
    try:
        if not pa.types.is_list(as_):
            return pa.array([value], as_)
        values = value if isinstance(value, pa.Array) else pa.array(value, as_.value_type)
        if values.type != as_.value_type:
            values = values.cast(as_.value_type)
        return pa.ListArray.from_arrays(pa.array([0, len(values)], pa.int32()), values).cast(as_)
    except (pa.ArrowException, TypeError, OverflowError) as error:
        raise ValueError(f"column `{name}`: expected {as_}: {error}") from error
