"""Writes logs of realo from numpy arrays. Needs numpy alone; docs/log-format.md says what is written.

    from realo_log import LogWriter, agent, boxes

    with LogWriter("my.mcap", [agent("car", "vehicle", footprint=[-1, 3.5, -0.9, 0.9])], source="our car") as log:
        log.pose("car", stamp, [x, y, z], [qx, qy, qz, qw])
        log.sweep("car", stamp, points, intensity, ready=stamp + 100_000_000)
        log.truth("car", stamp, boxes(centers, sizes, yaws, classes, track=ids), ready=stamp + 100_000_000)

Times are whole nanoseconds since 1970; `ready` is when a message existed, by default its stamp.
"""

import json
import struct
import zlib

import numpy as np

MAGIC = b"\x89MCAP0\r\n"
CHUNK = 1 << 20
POINT = np.dtype({"names": ["x", "y", "z", "intensity", "ring", "time"],
                  "formats": ["<f4", "<f4", "<f4", "u1", "<u2", "<i4"],
                  "offsets": [0, 4, 8, 12, 14, 16], "itemsize": 20})
DATATYPE = {"f4": 7, "u1": 2, "u2": 4, "i4": 5}
DEFINITIONS = {
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec\n",
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id\n",
    "sensor_msgs/PointField": "string name\nuint32 offset\nuint8 datatype\nuint32 count\n",
    "sensor_msgs/PointCloud2": "std_msgs/Header header\nuint32 height\nuint32 width\nsensor_msgs/PointField[] fields\n"
    "bool is_bigendian\nuint32 point_step\nuint32 row_step\nuint8[] data\nbool is_dense\n",
    "geometry_msgs/Point": "float64 x\nfloat64 y\nfloat64 z\n",
    "geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z\n",
    "geometry_msgs/Quaternion": "float64 x\nfloat64 y\nfloat64 z\nfloat64 w\n",
    "geometry_msgs/Pose": "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n",
    "geometry_msgs/PoseWithCovariance": "geometry_msgs/Pose pose\nfloat64[36] covariance\n",
    "geometry_msgs/PoseWithCovarianceStamped": "std_msgs/Header header\ngeometry_msgs/PoseWithCovariance pose\n",
    "vision_msgs/ObjectHypothesis": "string class_id\nfloat64 score\n",
    "vision_msgs/ObjectHypothesisWithPose":
    "vision_msgs/ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose\n",
    "vision_msgs/BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size\n",
    "vision_msgs/Detection3D": "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\n"
    "vision_msgs/BoundingBox3D bbox\nstring id\n",
    "vision_msgs/Detection3DArray": "std_msgs/Header header\nvision_msgs/Detection3D[] detections\n",
    "realo_msgs/BoxesInfo": "std_msgs/Header header\nuint64 seq\nbool key\nfloat64[] pose\nfloat64[] yaw\n"
    "float64[] velocity\nfloat64[] covariance\nstring[] agents\nuint32[] points\n",
    "realo_msgs/Views": "std_msgs/Header header\nfloat64[] pose\nfloat64[] focal\nfloat64[] center\nuint32[] size\n"
    "float64[] margin\n",
}


def agent(name, kind, footprint=None, sensor="", sensor_position=None):
    """`kind`: vehicle or roadside; `footprint`: [x min, x max, y min, y max] in the body frame, m."""
    return {"name": name, "kind": kind, "footprint": footprint, "sensor": sensor, "sensor_position": sensor_position}


def boxes(center, size, yaw, classes, score=None, velocity=None, track=None):
    """`center` and `size` (length, width, height) are (n, 3), m; `yaw` (n), rad; `velocity` (n, 3), m/s; body frame."""
    center, size, n = np.reshape(center, (-1, 3)), np.reshape(size, (-1, 3)), len(classes)
    velocity = np.full((n, 3), np.nan) if velocity is None else np.reshape(velocity, (-1, 3))
    found = {"center": center, "size": size, "yaw": np.asarray(yaw, float), "classes": classes, "velocity": velocity,
             "score": np.ones(n) if score is None else score, "track": [""] * n if track is None else track}
    lengths = {name: len(column) for name, column in found.items()}
    if set(lengths.values()) != {n}:
        raise ValueError(f"boxes: expected {n} of each column, as there are classes, found {lengths}")
    return found


def view(position, quaternion, focal, center, size, margin=0):
    """What a camera has in its image: body from camera (x right, y down, z ahead), m and x y z w; focal lengths, principal
    point and size of the image, pixels; how far what was labelled in it may lie beside it at the stamp, m."""
    found = {"pose": [*position, *quaternion], "focal": [*focal], "center": [*center], "size": [*size], "margin": [margin]}
    expected = {"pose": 7, "focal": 2, "center": 2, "size": 2, "margin": 1}
    for name, numbers in found.items():
        if len(numbers) != expected[name] or not np.isfinite(numbers).all():
            raise ValueError(f"view: `{name}`: expected {expected[name]} finite numbers, found {numbers}")
    if min(found["focal"]) <= 0 or min(found["size"]) < 1 or margin < 0:
        raise ValueError(f"view: expected focal lengths and a size above 0 and a margin from 0, found {found}")
    return found


class Cdr:
    """A message in little-endian CDR: every number begins at a multiple of its size, counted behind the head."""

    def __init__(self, stamp, frame):
        self.bytes = bytearray(b"\0\1\0\0")
        self.header(stamp, frame)

    def align(self, size):
        self.bytes += bytes(-(len(self.bytes) - 4) % size)

    def put(self, codes, *values):
        for code, value in zip(codes, values, strict=True):
            self.align(struct.calcsize(code))
            self.bytes += struct.pack("<" + code, value)

    def text(self, text):
        data = text.encode() + b"\0"
        self.put("I", len(data))
        self.bytes += data

    def header(self, stamp, frame):
        self.put("iI", stamp // 10**9, stamp % 10**9)
        self.text(frame)

    def fixed(self, values):
        self.align(8)
        self.bytes += np.asarray(values, "<f8").tobytes()

    def array(self, values, dtype):
        values = np.asarray(values, dtype).ravel()
        self.put("I", len(values))
        if len(values):
            self.align(values.itemsize)
            self.bytes += values.tobytes()


def text(value):
    return struct.pack("<I", len(value.encode())) + value.encode()


def mapped(pairs):
    data = b"".join(pairs)
    return struct.pack("<I", len(data)) + data


def record(opcode, body):
    return struct.pack("<BQ", opcode, len(body)) + body


def schema_text(name):
    order = [name]
    for known in order:
        used = [line.split(" ")[0].split("[")[0] for line in DEFINITIONS[known].splitlines()]
        order += [t for t in dict.fromkeys(used) if t in DEFINITIONS and t not in order]
    return ("=" * 80 + "\n").join([DEFINITIONS[name]] + [f"MSG: {t}\n{DEFINITIONS[t]}" for t in order[1:]])


class LogWriter:
    """Writes one log; `close` writes the index, without which a reader goes through the whole file."""

    def __init__(self, path, agents, source, protocol="default", key_frames="all", map_frame="map"):
        self.file, self.map_frame = open(path, "wb"), map_frame
        self.agents = {a["name"]: {"sweeps": {}, "key_frames": []} for a in agents}
        self.schemas, self.channels, self.metadata, self.chunks = {}, {}, [], []
        # Clouds never share a chunk with smaller messages.
        self.open = {False: None, True: None}
        self.file.write(MAGIC + record(1, text("ros2") + text("realo_log.py")))
        self.write_metadata("realo", {"format": "1", "program": "realo_log.py", "source": source, "protocol": protocol,
                                      "agents": json.dumps(agents), "map_frame": map_frame, "key_frames": key_frames})

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.close()

    def pose(self, agent, stamp, position, quaternion, covariance=None, ready=None, truth=False):
        """Map from body: position, m, and unit quaternion x y z w; as believed or, with `truth`, as it was."""
        cdr = Cdr(stamp, self.map_frame)
        cdr.fixed([*position, *quaternion])
        cdr.fixed(np.zeros(36) if covariance is None else np.ravel(covariance))
        self.write(agent, "pose_truth" if truth else "pose", "geometry_msgs/PoseWithCovarianceStamped", stamp, ready, cdr)

    def sweep(self, agent, stamp, points, intensity=0, time=0, ring=0, ready=None):
        """`points` (n, 3) in the body frame, m; `intensity` 0..255; `time` ns from the stamp; `ring` the beam."""
        rows = np.zeros(len(points), POINT)
        rows["x"], rows["y"], rows["z"] = np.reshape(points, (-1, 3)).T
        rows["intensity"], rows["time"], rows["ring"] = intensity, time, ring
        cdr = Cdr(stamp, f"{agent}/body")
        cdr.put("III", 1, len(rows), len(POINT.names))
        for name in POINT.names:
            dtype, offset = POINT.fields[name]
            cdr.text(name)
            cdr.put("IBI", offset, DATATYPE[dtype.str[1:]], 1)
        cdr.put("BII", 0, POINT.itemsize, rows.nbytes)
        cdr.array(np.frombuffer(rows.tobytes(), "u1"), "u1")
        cdr.put("B", 1)
        sweeps = self.agents[agent]["sweeps"]
        sweeps[stamp] = len(sweeps)
        self.write(agent, "sweeps", "std_msgs/Header", stamp, ready, Cdr(stamp, f"{agent}/body"))
        self.write(agent, "points", "sensor_msgs/PointCloud2", stamp, ready, cdr)

    def detections(self, agent, stamp, boxes, ready=None):
        """Boxes that the agent found in its sweep at `stamp`; write the sweep first."""
        self.write_boxes(agent, "detections", stamp, boxes, ready, False, None)

    def truth(self, agent, stamp, boxes, points=None, key=True, ready=None, views=()):
        """All objects at the sweep's stamp, the agent's own `points` on each, whether the frame is scored, and the `view`s in
        which objects could be labelled, if not everywhere."""
        if key:
            self.agents[agent]["key_frames"].append(stamp)
        self.write_views(agent, "ground_truth", stamp, views, ready)
        self.write_boxes(agent, "ground_truth", stamp, boxes, ready, key, points)

    def own_labels(self, agent, stamp, boxes, points=None, key=True, ready=None, views=()):
        """What the agent's own side labelled by its own sensors; the rest as in `truth`."""
        self.write_views(agent, "own_labels", stamp, views, ready)
        self.write_boxes(agent, "own_labels", stamp, boxes, ready, key, points)

    def write_views(self, agent, stream, stamp, views, ready):
        if not views:
            return
        cdr = Cdr(stamp, f"{agent}/body")
        for name, dtype in ("pose", "<f8"), ("focal", "<f8"), ("center", "<f8"), ("size", "<u4"), ("margin", "<f8"):
            cdr.array([v[name] for v in views], dtype)
        self.write(agent, stream + "_views", "realo_msgs/Views", stamp, ready, cdr)

    def write_boxes(self, agent, stream, stamp, b, ready, key, points):
        frame = f"{agent}/body"
        cdr, info = Cdr(stamp, frame), Cdr(stamp, frame)
        cdr.put("I", len(b["classes"]))
        for i, name in enumerate(b["classes"]):
            half = b["yaw"][i] / 2
            pose = [*b["center"][i], 0, 0, np.sin(half), np.cos(half)]
            cdr.header(stamp, frame)
            cdr.put("I", 1)
            cdr.text(name)
            cdr.put("d", b["score"][i])
            cdr.fixed(pose + [0] * 36)
            cdr.fixed(pose + [*b["size"][i]])
            cdr.text(str(b["track"][i]))
        # Boxes of no sweep have the greatest number.
        info.put("QB", self.agents[agent]["sweeps"].get(stamp, 2**64 - 1), key)
        for column in [], b["yaw"], b["velocity"], []:
            info.array(column, "<f8")
        info.put("I", int(points is not None))
        if points is not None:
            info.text(agent)
        info.array([] if points is None else points, "<u4")
        self.write(agent, stream, "vision_msgs/Detection3DArray", stamp, ready, cdr)
        self.write(agent, stream + "_info", "realo_msgs/BoxesInfo", stamp, ready, info)

    def write(self, agent, stream, schema, stamp, ready, cdr):
        if agent not in self.agents:
            raise ValueError(f"agent `{agent}` is not one of {', '.join(self.agents)}, which the log was made with")
        bulk, ready, topic = stream == "points", int(stamp if ready is None else ready), f"/{agent}/{stream}"
        chunk = self.open[bulk] = self.open[bulk] or {"data": bytearray(), "index": {}}
        if topic not in self.channels:
            chunk["data"] += self.define(topic, schema)
        channel = self.channels[topic]
        head = struct.pack("<HIQQ", channel["id"], channel["count"], ready, int(stamp))
        chunk["index"].setdefault(channel["id"], []).append((ready, len(chunk["data"])))
        chunk["data"] += record(5, head + bytes(cdr.bytes))
        channel["count"] += 1
        if len(chunk["data"]) >= CHUNK:
            self.flush(bulk)

    def define(self, topic, schema):
        if schema not in self.schemas:
            number, full = len(self.schemas) + 1, schema.replace("/", "/msg/")
            body = struct.pack("<H", number) + text(full) + text("ros2msg") + text(schema_text(schema))
            self.schemas[schema] = (number, record(3, body))
        (number, definition), id = self.schemas[schema], len(self.channels)
        body = struct.pack("<HH", id, number) + text(topic) + text("cdr") + mapped([])
        self.channels[topic] = {"id": id, "count": 0, "record": record(4, body)}
        return definition + self.channels[topic]["record"]

    def flush(self, bulk):
        chunk, self.open[bulk] = self.open[bulk], None
        if not chunk:
            return
        data, times = bytes(chunk["data"]), [time for entries in chunk["index"].values() for time, _ in entries]
        span, at = struct.pack("<QQ", min(times), max(times)), self.file.tell()
        head = struct.pack("<QI", len(data), zlib.crc32(data)) + text("") + struct.pack("<Q", len(data))
        body, behind, offsets = record(6, span + head + data), b"", []
        for id, entries in sorted(chunk["index"].items()):
            offsets.append(struct.pack("<HQ", id, at + len(body) + len(behind)))
            behind += record(7, struct.pack("<H", id) + mapped([struct.pack("<QQ", *entry) for entry in entries]))
        index = span + struct.pack("<QQ", at, len(body)) + mapped(offsets) + struct.pack("<Q", len(behind)) + text("")
        index += struct.pack("<QQ", len(data), len(data))
        self.chunks.append((min(times), max(times), record(8, index)))
        self.file.write(body + behind)

    def write_metadata(self, name, entries):
        body = record(12, text(name) + mapped([text(key) + text(value) for key, value in entries.items()]))
        self.metadata.append(record(13, struct.pack("<QQ", self.file.tell(), len(body)) + text(name)))
        self.file.write(body)

    def close(self):
        """Writes what is left and the index."""
        self.flush(False)
        self.flush(True)
        key_frames = {name: known["key_frames"] for name, known in self.agents.items()}
        self.write_metadata("realo_end", {"key_frames": json.dumps(key_frames)})
        self.file.write(record(15, struct.pack("<I", 0)))
        counts = {channel["id"]: channel["count"] for channel in self.channels.values()}
        first = min((chunk[0] for chunk in self.chunks), default=0)
        last = max((chunk[1] for chunk in self.chunks), default=0)
        numbers = sum(counts.values()), len(self.schemas), len(counts), 0, len(self.metadata), len(self.chunks), first, last
        statistics = struct.pack("<QHIIIIQQ", *numbers) + mapped([struct.pack("<HQ", *pair) for pair in counts.items()])
        start = self.file.tell()
        summary = b"".join([known[1] for known in self.schemas.values()] + [c["record"] for c in self.channels.values()]
                           + [record(11, statistics)] + [chunk[2] for chunk in self.chunks] + self.metadata)
        footer = struct.pack("<BQQQ", 2, 20, start, 0)
        self.file.write(summary + footer + struct.pack("<I", zlib.crc32(summary + footer)) + MAGIC)
        self.file.close()
