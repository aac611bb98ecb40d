"""Writes logs of realo from numpy arrays. Needs numpy alone; docs/reference/log-format.md says what is written.

    from realo_log import LogWriter, agent, boxes

    with LogWriter("my.mcap", [agent("car", "vehicle", footprint=[-1, 3.5, -0.9, 0.9])], source="our car") as log:
        log.pose("car", stamp, [x, y, z], [qx, qy, qz, qw])
        log.sweep("car", stamp, points, intensity, ready=stamp + 100_000_000)
        log.truth("car", stamp, boxes(centers, sizes, yaws, classes, track=ids), ready=stamp + 100_000_000)

Times are whole nanoseconds since 1970; `ready` is when a message existed, by default its stamp.

A value that does not fit is scaled by a rule that its method states, or refused with a ValueError that names the argument; none is
cut or wrapped. The log appears at its path when the `with` block ends well; an exception in it leaves no log.
"""

import json
import os
import re
import struct
import zlib

import numpy as np

MAGIC = b"\x89MCAP0\r\n"
CHUNK = 1 << 20
POINT = np.dtype({"names": ["x", "y", "z", "intensity", "ring", "time"],
                  "formats": ["<f4", "<f4", "<f4", "u1", "<u2", "<i4"],
                  "offsets": [0, 4, 8, 12, 14, 16], "itemsize": 20})
DATATYPE = {"f4": 7, "u1": 2, "u2": 4, "i4": 5}
# What sensors give as their brightest: what exceeds a byte is scaled by the first that holds it.
BRIGHTEST = 255, 1023, 4095, 65535
# Nothing that a sensor sees lies farther from its agent, m.
FARTHEST = 100_000
# No place lies farther from the origin of a map, m: twice around the Earth.
WORLD = 80_000_000
# Frames of motion sensors, by their streams.
FRAMES = {"imu": "imu", "fix": "antenna", "wheels": "axle"}
# Names are parts of topics, folders and frames.
NAME = re.compile(r"[A-Za-z0-9_]([A-Za-z0-9_.-]{0,62}[A-Za-z0-9_-])?")
# From here on floats skip whole numbers.
SKIPPING = 2**53
SECOND = 10**9
# Seconds from 2010 to 2040: a stamp of that size is one in another unit.
EPOCH = 1_262_304_000, 2_208_988_800
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
    "geometry_msgs/Twist": "geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular\n",
    "geometry_msgs/TwistWithCovariance": "geometry_msgs/Twist twist\nfloat64[36] covariance\n",
    "geometry_msgs/TwistWithCovarianceStamped": "std_msgs/Header header\ngeometry_msgs/TwistWithCovariance twist\n",
    "geometry_msgs/Transform": "geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation\n",
    "geometry_msgs/TransformStamped": "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/Transform transform\n",
    "tf2_msgs/TFMessage": "geometry_msgs/TransformStamped[] transforms\n",
    "sensor_msgs/Imu": "std_msgs/Header header\ngeometry_msgs/Quaternion orientation\nfloat64[9] orientation_covariance\n"
    "geometry_msgs/Vector3 angular_velocity\nfloat64[9] angular_velocity_covariance\n"
    "geometry_msgs/Vector3 linear_acceleration\nfloat64[9] linear_acceleration_covariance\n",
    "sensor_msgs/NavSatStatus": "int8 status\nuint16 service\n",
    "sensor_msgs/NavSatFix": "std_msgs/Header header\nsensor_msgs/NavSatStatus status\nfloat64 latitude\nfloat64 longitude\n"
    "float64 altitude\nfloat64[9] position_covariance\nuint8 position_covariance_type\n",
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


def refuse(where, name, expected, found, advice):
    raise ValueError(f"{where}: `{name}`: expected {expected}, found {found}; {advice}")


def has_bool(values):
    """Whether a list holds truth values, which numpy would take for 0 and 1."""
    if isinstance(values, (list, tuple)):
        return any(has_bool(value) for value in values)
    return isinstance(values, (bool, np.bool_))


def numbers(where, name, values):
    """An array of numbers as it was given; what is not a number, or masked, is refused."""
    if np.ma.is_masked(values):
        refuse(where, name, "an array without masked elements", f"{np.ma.count_masked(values)}", "leave them out, or use .filled")
    if has_bool(values):
        refuse(where, name, "numbers", f"truth values ({str(values)[:60]})", "turn them into numbers")
    try:
        array = np.asarray(values)
    except ValueError as error:
        refuse(where, name, "rows of one length", f"others ({error})", "give an array of numpy")
    if array.dtype.kind not in "iuf":
        found = f"fields {', '.join(array.dtype.names)}" if array.dtype.names else f"{array.dtype} ({str(values)[:60]})"
        refuse(where, name, "numbers", found, "stack the columns of a table into a plain array, turn text into numbers")
    return array


def column_of(where, name, values, n, shape=None):
    """One number for each of `n` rows, or one for all. `shape`: of organised rows, in whose order the numbers may be too."""
    array = numbers(where, name, values)
    if not array.ndim:
        return np.broadcast_to(array, (n,))
    if array.size != n:
        refuse(where, name, f"{n} numbers, one a row, or a single one", f"shape {array.shape}", "pass one column")
    if array.ndim > 1 and array.shape not in ((n, 1), (1, n), shape):
        found, advice = f"shape {array.shape}, whose order is another", f"pass {name}.ravel() if its order is that of the rows"
        refuse(where, name, f"one column of {n} numbers" + (f", or shape {shape}" if shape else ""), found, advice)
    return array.ravel()


def listed(where, name, values, each):
    """Texts or tracks as a list: of a list, a tuple, a range or a column of numpy or pandas, whose order is known."""
    if not isinstance(values, (list, tuple, range)) and getattr(values, "ndim", 0) != 1:
        found = f"the text {values!r}" if isinstance(values, (str, bytes)) else f"{values!r}"
        refuse(where, name, each, found[:80], f"pass a list, such as [{values!r}] * n"[:80])
    return list(values)


def flag(where, name, value):
    """True or False, and nothing that Python takes for one of them, such as the text "False"."""
    if not isinstance(value, (bool, np.bool_)):
        refuse(where, name, "True or False", f"{value!r}", "compare with what you mean")
    return bool(value)


def rows_of(where, name, values, width, n=None):
    """An (n, width) array, also of an organised (..., width) one."""
    array = numbers(where, name, values)
    if array.size == 0 and not n:
        return array.reshape(-1, width)
    if array.ndim == 1 and n == 1:
        array = array[None]
    if array.ndim < 2 or array.shape[-1] != width:
        turned = array.ndim == 2 and array.shape[0] == width
        advice = f"pass {name}.T" if turned else f"pass {name}[:, :{width}], and other columns by their own names"
        refuse(where, name, f"shape (n, {width})", f"{array.shape}", advice)
    array = array.reshape(-1, width)
    if n is not None and len(array) != n:
        refuse(where, name, f"{n} rows, as there are classes", f"{len(array)}", "give each box one row")
    return array


def finite(where, name, array):
    bad = np.count_nonzero(~np.isfinite(array))
    if bad:
        refuse(where, name, "finite numbers", f"{bad} of {array.size} that are not", "leave those rows out, or mend them")
    return array


def between(where, name, array, low, high, advice):
    """All of an array within limits, which NaN is not."""
    outside = array[~((array >= low) & (array <= high))]
    if outside.size:
        refuse(where, name, f"{low} to {high}", f"{outside.ravel()[0]} ({outside.size} of {array.size} outside)", advice)
    return array


def whole(where, name, array, low, high):
    """Whole numbers within limits, as int64."""
    advice = "scale them, or number anew"
    between(where, name, array, low, high, advice)
    if array.dtype.kind == "f" and (array != np.rint(array)).any():
        refuse(where, name, "whole numbers", f"{array[array != np.rint(array)][0]}", advice)
    return array.astype(np.int64)


def doubles(where, name, values, n):
    """`n` finite doubles; single precision is refused where it is coarser than a millimetre."""
    array = numbers(where, name, values)
    if array.size != n:
        refuse(where, name, f"{n} numbers", f"shape {array.shape}", "see docs/reference/log-format.md")
    finite(where, name, array)
    given = [array.dtype] + [v.dtype for v in values if hasattr(v, "dtype")] if isinstance(values, (list, tuple)) else [array.dtype]
    for dtype in given:
        if dtype.kind == "f" and dtype.itemsize < 8:
            most = float(np.abs(array).max())
            step = float(np.spacing(np.asarray(most, dtype)))
            if not step <= 1e-3:
                advice = "compute and keep it in float64, or subtract an origin nearby before"
                refuse(where, name, "float64 so far from the origin", f"{dtype} of {most:.1f}, whose steps are {step} m", advice)
    return array.astype("<f8").ravel()


def rotation(where, name, values):
    """A unit quaternion x y z w; lengths of 0.99 to 1.01 are made 1."""
    q = doubles(where, name, values, 4)
    norm = float(np.sqrt(np.sum(q * q)))
    if not 0.99 <= norm <= 1.01:
        advice = "divide it by its length; a heading alone is [0, 0, sin(yaw / 2), cos(yaw / 2)]"
        refuse(where, name, "a unit quaternion x y z w", f"{q.tolist()} of length {norm:.3f}", advice)
    # A unit quaternion keeps its bits.
    return q if abs(norm * norm - 1) < 1e-12 else q / norm


def variance(where, name, value):
    """A variance; 0, which says that it is unknown, for None."""
    found = doubles(where, name, [0 if value is None else value], 1)
    between(where, name, found, 0, np.inf, "a variance is a standard deviation squared")
    if value is not None and not found[0]:
        refuse(where, name, "a variance above 0", "0", "no sensor is exact; None says that it is not known")
    return float(found[0])


def geodetic(where, name, values):
    """Latitude and longitude on WGS 84, degrees, and height over its ellipsoid, m."""
    place = doubles(where, name, values, 3)
    dtypes = [getattr(of, "dtype", None) for of in [values, *values]]
    if any(dtype is not None and dtype.kind == "f" and dtype.itemsize < 8 for dtype in dtypes):
        refuse(where, name, "float64", "single precision, whose degrees are half a metre apart", "compute and keep it in float64")
    for part, at, most in ("latitude", 0, 90), ("longitude", 1, 360), ("height", 2, 100_000):
        between(where, f"{name} ({part})", place[at:at + 1], -most, most, "degrees north, degrees east, metres over the ellipsoid")
    return place


def nanos(where, name, value):
    """A time as whole ns since 1970: an integer, or numpy's datetime64."""
    if isinstance(value, np.datetime64):
        # Years first: a far one has no ns in 64 bits. What is no time at all is before 1970.
        years = int(value.astype("datetime64[Y]").astype(np.int64))
        if not 0 <= years <= 68:
            refuse(where, name, "a time from 1970 to 2038", f"{value}", "see whether its unit is another")
        value = value.astype("datetime64[ns]").astype(np.int64)
    found = np.asarray(value)
    if found.ndim or found.dtype.kind not in "iu":
        advice = "floats of that size are 256 ns apart: keep integers, or round(seconds * 10**9)"
        refuse(where, name, "whole nanoseconds since 1970", f"{value!r} ({type(value).__name__})", advice)
    if not 0 <= int(value) < 2**31 * SECOND:
        refuse(where, name, "nanoseconds from 1970 to 2038", f"{value}", "see whether its unit or its sign is another")
    return int(value)


def plain_text(where, name, value):
    """Text that can be written as UTF-8."""
    try:
        value = value.decode() if isinstance(value, bytes) else value
        fits = isinstance(value, str) and "\0" not in value and value.encode() is not None
    except UnicodeError:
        fits = False
    if not fits:
        refuse(where, name, "text without zeros", f"{value!r}", "give a str, or bytes in UTF-8")
    return str(value)


def some_text(where, name, value):
    """Text that is not empty."""
    value = plain_text(where, name, value)
    if not value.strip():
        refuse(where, name, "a name", f"{value!r}", "name it")
    return value


def track_text(where, value):
    """A track as text: a float that is whole (a table of pandas) loses its `.0`; None, NaN and what is masked are no track."""
    if isinstance(value, np.ndarray) and not value.ndim and value is not np.ma.masked:
        value = value[()]
    if value is None or value is np.ma.masked or type(value).__name__ in ("NAType", "NaTType"):
        return ""
    if isinstance(value, (str, bytes)):
        return plain_text(where, "track", value)
    if isinstance(value, (bool, np.bool_)) or np.ndim(value) or isinstance(value, (dict, set, frozenset)):
        refuse(where, "track", "texts or numbers", f"{value!r}", "give each object a text or a number")
    if isinstance(value, (float, np.floating)):
        if np.isnan(value):
            return ""
        if not abs(value) < SKIPPING:
            advice = "so large floats have lost digits: keep tracks as integers or texts"
            refuse(where, "track", f"floats below {SKIPPING}", f"{value!r}", advice)
        value = int(value) if float(value).is_integer() else float(value)
    return plain_text(where, "track", str(value))


def agent(name, kind, footprint=None, sensor="", sensor_position=None):
    """`kind`: vehicle or roadside; `footprint`: [x min, x max, y min, y max] in the body frame, m."""
    where = f"agent `{name}`"
    if kind not in ("vehicle", "roadside"):
        refuse(where, "kind", "vehicle or roadside", f"{kind!r}", "take the nearer one")
    if footprint is not None:
        footprint = doubles(where, "footprint", footprint, 4).tolist()
        if not (footprint[0] < footprint[1] and footprint[2] < footprint[3]):
            refuse(where, "footprint", "[x min, x max, y min, y max], m", f"{footprint}", "order it so")
        advice = "give the outline of the vehicle in metres, not in centimetres"
        between(where, "footprint", np.array(footprint), -30, 30, advice)
    if sensor_position is not None:
        sensor_position = doubles(where, "sensor_position", sensor_position, 3).tolist()
    name, sensor = plain_text(where, "name", name), plain_text(where, "sensor", sensor)
    if not NAME.fullmatch(name) or name in ("tf", "tf_static"):
        expected = "1 to 64 letters, digits, `_`, `-` or `.`, first a letter, a digit or `_`, last no `.`"
        refuse(where, "name", expected, f"{name!r}", "rename the agent; `tf` and `tf_static` are taken")
    return {"name": name, "kind": str(kind), "footprint": footprint, "sensor": sensor, "sensor_position": sensor_position}


def boxes(center, size, yaw, classes, score=None, velocity=None, track=None, where="boxes"):
    """`center` and `size` (length, width, height) are (n, 3), m; `yaw` (n), rad; `classes` text; `score` 0..1; `velocity` (n, 3),
    m/s, NaN where unknown; `track` any text or number, None where there is none; body frame."""
    classes = listed(where, "classes", classes, "a list with the class of each box")
    n, fields = len(classes), {}
    fields["center"] = finite(where, "center", rows_of(where, "center", center, 3, n)).astype("<f8")
    advice = "boxes lie in the body frame of their agent: bring them there, in float64"
    between(where, "center", fields["center"], -FARTHEST, FARTHEST, advice)
    fields["size"] = finite(where, "size", rows_of(where, "size", size, 3, n)).astype("<f8")
    between(where, "size", fields["size"], 1e-6, FARTHEST, "leave out boxes without extent")
    fields["yaw"] = finite(where, "yaw", column_of(where, "yaw", yaw, n)).astype("<f8")
    advice = "degrees become radians by np.radians; wrap turns to -pi..pi"
    between(where, "yaw", fields["yaw"], -4 * np.pi, 4 * np.pi, advice)
    fields["classes"] = [some_text(where, "classes", name) for name in classes]
    velocity = np.full((n, 3), np.nan) if velocity is None else rows_of(where, "velocity", velocity, 3, n)
    if np.isinf(velocity).any():
        refuse(where, "velocity", "m/s, or NaN where it is unknown", "infinity", "give NaN there")
    fields["velocity"] = velocity.astype("<f8")
    score = column_of(where, "score", 1.0 if score is None else score, n).astype("<f8")
    fields["score"] = between(where, "score", score, 0, 1, "scale them: per cent are score / 100")
    track = [""] * n if track is None else listed(where, "track", track, f"{n} tracks, one a box")
    if len(track) != n:
        refuse(where, "track", f"{n} tracks, one a box", f"{len(track)}", "give each box one, None where it has none")
    fields["track"] = [track_text(where, one) for one in track]
    return fields


def view(position, quaternion, focal, center, size, margin=0):
    """What a camera has in its image: body from camera (x right, y down, z ahead), m and x y z w; focal lengths, principal
    point and size of the image, pixels; how far what was labelled in it may lie beside it at the stamp, m."""
    found = {name: doubles("view", name, values, n) for name, values, n in (
        ("position", position, 3), ("focal", focal, 2), ("center", center, 2), ("size", size, 2), ("margin", [margin], 1))}
    between("view", "position", found["position"], -FARTHEST, FARTHEST, "it is that of the camera in the body frame, m")
    between("view", "focal", found["focal"], 1e-6, np.inf, "focal lengths are pixels")
    between("view", "margin", found["margin"], 0, FARTHEST, "it is metres, 0 where labels fit the image")
    pose = [*found.pop("position"), *rotation("view", "quaternion", quaternion)]
    return {"pose": pose, **found, "size": whole("view", "size", found["size"], 1, 2**32 - 1)}


def bright_bytes(where, values, shape, there, known, most):
    """Intensities as bytes; `known` has the range that was found for integers and for floats."""
    n = len(there)
    array = column_of(where, "intensity", values, n, shape)
    seen = array[there]
    finite(where, "intensity", seen)
    between(where, "intensity", seen, 0, np.inf, "shift them so that the darkest is 0")
    top, kind = float(seen.max(initial=0)), "floats" if array.dtype.kind == "f" else "integers"
    if most is not None:
        reach = float(doubles(where, "intensity_max", [most], 1)[0])
        between(where, "intensity_max", np.asarray([reach]), 1e-9, np.inf, "give the brightest that the sensor can report")
    elif array.dtype == np.uint8:
        reach = 255
    else:
        unit = kind == "floats" and top <= 1
        reach = known.get(kind) or (1 if unit else next((step for step in BRIGHTEST if top <= step), top))
        if top > 0:
            known[kind] = reach
    if top > reach:
        advice = f"the sweeps before were scaled by {reach} to 255: give intensity_max=, the sensor's brightest, to each sweep"
        refuse(where, "intensity", f"at most {reach}", f"{top}", advice)
    out = np.zeros(n, np.uint8)
    out[there] = np.rint(seen.astype("<f8") * (255 / reach))
    return out


def offsets(where, values, shape, there, stamp):
    """Times of points as ns from the stamp."""
    n = len(there)
    array = column_of(where, "time", values, n, shape)
    seen = finite(where, "time", array[there])
    out = np.zeros(n, np.int64)
    if not seen.size:
        return out
    low, high = seen.min(), seen.max()
    near = lambda unit, origin, min=0, most=1: (  # noqa: E731
        max(abs(low - origin), abs(high - origin)) * unit < most * SECOND
        and max(abs(low - origin), abs(high - origin)) * unit >= min)
    exact = array.dtype.kind != "f" or array.dtype.itemsize == 8
    seconds, rest = divmod(stamp, SECOND)
    if array.dtype.kind != "f":
        # As Python's integers, which do not wrap.
        low, high = int(low), int(high)
        if near(1, 0):
            out[there] = seen
        elif near(1, stamp):
            out[there] = seen.astype(np.int64) - stamp
        else:
            refuse_time(where, seen, stamp)
    elif near(SECOND, 0, 0, 1 + 1e-9):
        out[there] = np.rint(seen.astype("<f8") * SECOND)
    elif near(1, 0, 5_000_000):
        out[there] = np.rint(seen.astype("<f8"))
    elif exact and near(SECOND, stamp / SECOND):
        # Whole seconds first, whose difference is exact.
        out[there] = np.rint((seen - seconds) * SECOND) - rest
    elif exact and near(1, stamp):
        out[there] = np.rint(seen - seconds * SECOND) - rest
    else:
        refuse_time(where, seen, stamp)
    return out


def refuse_time(where, seen, stamp):
    expected = "ns from the stamp, s from the stamp as floats, or ns or s (float64) since 1970, within 1 s of the stamp"
    found = f"{seen.min()} to {seen.max()} ({seen.dtype}) at the stamp {stamp}"
    refuse(where, "time", expected, found, "give whole ns from the stamp, such as np.round(microseconds * 1000).astype(np.int64)")


class Cdr:
    """A message in little-endian CDR: every number begins at a multiple of its size, counted behind the head."""

    def __init__(self, stamp, frame):
        self.bytes = bytearray(b"\0\1\0\0")
        if frame is not None:
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


def refuse_foreign(path):
    """Refuses to replace what is neither empty nor a log of realo."""
    if not os.path.exists(path):
        return
    with open(path, "rb") as file:
        head = file.read(4096)
    if head and not (head.startswith(MAGIC) and b"realo" in head):
        advice = "choose another path, or force=True to replace it"
        refuse("LogWriter", "path", "no file, or a log of realo", f"something else in {path}", advice)


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
    """Writes one log; `close` writes the index and gives the file its name.

    Until then it is `PATH.PID.partial`. An exception inside of `with` removes it; what was at the path before stays.
    `force` replaces a file there that is not a log of realo. `clock="other"`: stamps do not count from 1970. `map_origin`: where the
    map's origin is, as in `fix`, which needs it.
    """

    def __init__(self, path, agents, source, protocol="default", key_frames="all", map_frame="map", force=False, clock="1970",
                 map_origin=None):
        self.map_frame, self.clock, self.first = some_text("LogWriter", "map_frame", map_frame), clock, None
        if clock not in ("1970", "other"):
            refuse("LogWriter", "clock", "1970 or other", f"{clock!r}", "stamps since 1970 are the rule")
        force, made = flag("LogWriter", "force", force), set(agent("a", "vehicle"))
        if not isinstance(agents, (list, tuple)) or not agents or not all(isinstance(a, dict) and set(a) == made for a in agents):
            refuse("LogWriter", "agents", "a list of what agent(...) gives", f"{agents!r}"[:80], "pass [agent(name, kind), ...]")
        self.agents = {a["name"]: {"sweeps": {}, "key_frames": [], "brightest": {}, "written": set()} for a in agents}
        if len({name.lower() for name in self.agents}) != len(agents):
            found = f"{[a['name'] for a in agents]}"
            refuse("LogWriter", "agents", "names that differ by more than upper and lower case", found, "rename one")
        about = {"format": "1", "program": "realo_log.py", "source": source, "protocol": protocol,
                 "agents": json.dumps(agents), "map_frame": map_frame, "key_frames": key_frames}
        about = {key: plain_text("LogWriter", key, value) for key, value in about.items()}
        self.mounted, self.has_origin = {}, map_origin is not None
        if self.has_origin:
            about["map_origin"] = json.dumps(geodetic("LogWriter", "map_origin", map_origin).tolist())
        self.path = os.path.realpath(path)
        folder = os.path.dirname(self.path)
        if not os.path.isdir(folder):
            refuse("LogWriter", "path", "a file in a folder that is there", self.path, f"make {folder} first")
        # A device has no name to take.
        whole_file = not os.path.exists(self.path) or os.path.isfile(self.path)
        if whole_file and not force:
            refuse_foreign(self.path)
        self.partial = f"{self.path}.{os.getpid()}.partial" if whole_file else None
        self.file = open(self.partial or self.path, "wb")
        self.schemas, self.channels, self.metadata, self.chunks = {}, {}, [], []
        # Clouds never share a chunk with smaller messages.
        self.open = {False: None, True: None}
        try:
            self.file.write(MAGIC + record(1, text("ros2") + text("realo_log.py")))
            self.write_metadata("realo", about)
        except BaseException:
            self.discard()
            raise

    def __enter__(self):
        return self

    def __exit__(self, kind, *error):
        if kind is None:
            self.close()
        else:
            self.discard()

    def discard(self):
        """Ends without a log: removes what was written."""
        try:
            self.file.close()
        except OSError:
            pass  # What is not written any more is removed.
        if self.partial and os.path.exists(self.partial):
            os.remove(self.partial)

    def stamp(self, where, value):
        """A stamp in ns; one that is a date in another unit is refused."""
        found = nanos(where, "stamp", value)
        if self.clock == "1970" and (self.first is None or self.first >= SECOND**2):
            for unit, size in ("s", 1), ("ms", 10**3), ("us", 10**6):
                if EPOCH[0] * size <= found < EPOCH[1] * size:
                    day = np.datetime64(found // size, "s")
                    advice = f'multiply by {SECOND // size}; if a clock of another kind shows that, LogWriter(..., clock="other")'
                    refuse(where, "stamp", "nanoseconds since 1970", f"{found}, which is {day} in {unit}", advice)
        if self.first is None:
            self.first = found
        return found

    def ready(self, where, stamp, value):
        """When a message existed: by default at its stamp, and never more than a second before it."""
        found = stamp if value is None else nanos(where, "ready", value)
        if found < stamp - SECOND:
            advice = "a message cannot exist before what it measures; see whether its unit is another"
            expected = f"nanoseconds from {stamp - SECOND} on, at most 1 s before the stamp"
            refuse(where, "ready", expected, f"{found}", advice)
        return found

    def once(self, where, agent, stream, stamp):
        """Refuses a second message of a sweep: the later one would hide the first."""
        written = self.agents[agent]["written"]
        if (stream, stamp) in written:
            refuse(where, "stamp", f"one message of {stream} at each stamp", f"a second one at {stamp}", "write each sweep once")
        written.add((stream, stamp))

    def known(self, agent):
        if not isinstance(agent, str) or agent not in self.agents:
            raise ValueError(f"agent `{agent}` is not one of {', '.join(self.agents)}, which the log was made with")
        return self.agents[agent]

    def pose(self, agent, stamp, position, quaternion, covariance=None, ready=None, truth=False):
        """Map from body: position, m, and unit quaternion x y z w; as believed or, with `truth`, as it was. In float64: single
        precision is refused far from the origin."""
        self.known(agent)
        where = f"pose of `{agent}` at {stamp}"
        stamp = self.stamp(where, stamp)
        cdr = Cdr(stamp, self.map_frame)
        position = doubles(where, "position", position, 3)
        between(where, "position", position, -WORLD, WORLD, "metres in the frame of the map")
        cdr.fixed([*position, *rotation(where, "quaternion", quaternion)])
        covariance = np.zeros(36) if covariance is None else doubles(where, "covariance", covariance, 36)
        between(where, "covariance", covariance[::7], 0, np.inf, "its diagonal holds variances")
        square = covariance.reshape(6, 6)
        if np.abs(square - square.T).max() > 1e-6 * np.abs(square).max():
            advice = "rows and columns are x, y, z and turns about x, y, z; symmetric as (c + c.T) / 2"
            refuse(where, "covariance", "a symmetric matrix", f"{np.abs(square - square.T).max()} between its halves", advice)
        cdr.fixed(covariance)
        self.write(agent, "pose_truth" if flag(where, "truth", truth) else "pose", "geometry_msgs/PoseWithCovarianceStamped", stamp, ready, cdr)

    def mount(self, agent, stream, position, quaternion=(0, 0, 0, 1)):
        """How an agent's motion sensor of a stream (`imu`, `fix`, `wheels`) lies in its body frame, m. Once, before its first message."""
        self.known(agent)
        where = f"mount of `{agent}`"
        if stream not in FRAMES:
            refuse(where, "stream", "imu, fix or wheels", f"{stream!r}", "other sensors are in the body frame")
        position = doubles(where, "position", position, 3)
        between(where, "position", position, -30, 30, "metres from the origin of the body frame")
        if (agent, stream) in self.mounted:
            refuse(where, "stream", "a sensor without a mount", f"a second mount of {stream}", "mount each once, before its messages")
        self.mounted[agent, stream] = [*position, *rotation(where, "quaternion", quaternion)]

    def motion(self, agent, stream, schema, stamp, ready, columns):
        """Writes a message of a motion sensor. Those that nobody mounted are at the origin of the body frame."""
        frame, known = f"{agent}/{FRAMES[stream]}", self.mounted.get((agent, stream), [0, 0, 0, 0, 0, 0, 1])
        if known is not None:
            transform = Cdr(stamp, None)
            transform.put("I", 1)
            transform.header(stamp, f"{agent}/body")
            transform.text(frame)
            transform.fixed(known)
            self.write(agent, "tf_static", "tf2_msgs/TFMessage", stamp, ready, transform)
            self.mounted[agent, stream] = None
        cdr = Cdr(stamp, frame)
        for codes, values in columns:
            cdr.put(codes, *values) if codes else cdr.fixed(values)
        self.write(agent, stream, schema, stamp, ready, cdr)

    def moment(self, agent, stream, stamp):
        """Where a message of a motion sensor is, in words, and its stamp in ns."""
        self.known(agent)
        where = f"{stream} of `{agent}` at {stamp}"
        return where, self.stamp(where, stamp)

    def imu(self, agent, stamp, angular_rate, acceleration, variances=None, ready=None):
        """A sample of an inertial unit along its own axes: rad/s, and m/s² with gravity in it, 9.8 upwards at rest. `variances` of
        white noise: of one rate and one acceleration. `stamp`: the end of the time that the sample is the mean of."""
        where, stamp = self.moment(agent, "imu", stamp)
        if variances is not None and len(listed(where, "variances", variances, "two numbers")) != 2:
            refuse(where, "variances", "two numbers, of a rate and an acceleration", f"{variances!r}", "None where they are not known")
        rate, force = [variance(where, "variances", of) * np.eye(3).ravel() for of in (variances if variances is not None else [None] * 2)]
        columns = [0, 0, 0, 1, -1] + [0] * 8, [*doubles(where, "angular_rate", angular_rate, 3), *rate], \
            [*doubles(where, "acceleration", acceleration, 3), *force]
        self.motion(agent, "imu", "sensor_msgs/Imu", stamp, ready, [("", column) for column in columns])

    def fix(self, agent, stamp, place, covariance=None, quality="single", ready=None):
        """What a satellite receiver says: latitude and longitude on WGS 84, degrees, and height over its ellipsoid, m; None without a
        position. `covariance`: 3 by 3, of east, north and up, m². `quality`: single, corrected (SBAS) or differential (also RTK)."""
        if not self.has_origin:
            refuse(f"fix of `{agent}`", "map_origin", "where the map's origin is", "none", "LogWriter(..., map_origin=[lat, lon, height])")
        where, stamp = self.moment(agent, "fix", stamp)
        kinds = "single", "corrected", "differential"
        if quality not in kinds:
            refuse(where, "quality", f"one of {', '.join(kinds)}", f"{quality!r}", "take the nearest")
        given = np.zeros(9) if covariance is None else doubles(where, "covariance", covariance, 9)
        square = given.reshape(3, 3)
        if covariance is not None and (np.abs(square - square.T).max() > 1e-6 * np.abs(square).max() or np.diag(square).min() <= 0):
            refuse(where, "covariance", "a symmetric matrix with variances above 0", f"{given.tolist()}", "of east, north and up, m²")
        place = [np.nan] * 3 if place is None else geodetic(where, "place", place)
        status = -1 if np.isnan(place[0]) else kinds.index(quality)
        columns = ("bH", [status, 1]), ("", place), ("", given), ("B", [0 if covariance is None else 3])
        self.motion(agent, "fix", "sensor_msgs/NavSatFix", stamp, ready, columns)

    def wheels(self, agent, stamp, speed, speed_variance=None, ready=None):
        """How fast the wheels of a fixed axle say that its middle moves ahead, m/s; backwards is negative."""
        where, stamp = self.moment(agent, "wheels", stamp)
        columns = [*doubles(where, "speed", [speed], 1)] + [0] * 5, [variance(where, "speed_variance", speed_variance)] + [0] * 35
        self.motion(agent, "wheels", "geometry_msgs/TwistWithCovarianceStamped", stamp, ready, [("", column) for column in columns])

    def sweep(self, agent, stamp, points, intensity=0, time=0, ring=0, ready=None, intensity_max=None):
        """`points` (n, 3) in the body frame, m; a row with NaN is a direction without a return.

        `intensity` becomes 0..255: bytes as they are; other numbers times 255 / `intensity_max`. Without it, the first sweep of the
        agent that is not dark decides: floats of at most 1 count to 1, others to the first of 255, 1023, 4095 and 65535 that holds
        them; a later sweep that is brighter is refused. `time`: ns from the stamp (integers; floats from 5 ms on), s from
        the stamp (floats of at most 1), or ns or s since 1970, within 1 s of the stamp. `ring`: the beam, 0..65535.
        """
        known, where = self.known(agent), f"sweep of `{agent}` at {stamp}"
        stamp = self.stamp(where, stamp)
        ready, points = self.ready(where, stamp, ready), numbers(where, "points", points)
        shape, points = points.shape[:-1], rows_of(where, "points", points, 3)
        n, there = len(points), np.isfinite(points).all(axis=1)
        if np.isinf(points).any():
            refuse(where, "points", "metres, or NaN in directions without a return", "infinity", "give NaN there")
        advice = "points lie in the body frame of their agent: bring them there, in float64"
        between(where, "points", points[there], -FARTHEST, FARTHEST, advice)
        cloud = np.zeros(n, POINT)
        cloud["x"], cloud["y"], cloud["z"] = points.T
        cloud["time"] = offsets(where, time, shape, there, stamp)
        cloud["ring"][there] = whole(where, "ring", column_of(where, "ring", ring, n, shape)[there], 0, 65535)
        # Last, since it decides the range of later sweeps.
        cloud["intensity"] = bright_bytes(where, intensity, shape, there, known["brightest"], intensity_max)
        self.once(where, agent, "sweeps", stamp)
        cdr = Cdr(stamp, f"{agent}/body")
        cdr.put("III", 1, n, len(POINT.names))
        for name in POINT.names:
            dtype, offset = POINT.fields[name]
            cdr.text(name)
            cdr.put("IBI", offset, DATATYPE[dtype.str[1:]], 1)
        cdr.put("BII", 0, POINT.itemsize, cloud.nbytes)
        cdr.array(np.frombuffer(cloud.tobytes(), "u1"), "u1")
        cdr.put("B", bool(there.all()))
        known["sweeps"][stamp] = len(known["sweeps"])
        self.write(agent, "sweeps", "std_msgs/Header", stamp, ready, Cdr(stamp, f"{agent}/body"))
        self.write(agent, "points", "sensor_msgs/PointCloud2", stamp, ready, cdr)

    def detections(self, agent, stamp, boxes, ready=None):
        """Boxes that the agent found in its sweep at `stamp`; write the sweep first."""
        self.write_boxes(agent, "detections", stamp, boxes, ready, False, None)

    def truth(self, agent, stamp, boxes, points=None, key=True, ready=None, views=()):
        """All objects at the sweep's stamp, the agent's own `points` on each, whether the frame is scored, and the `view`s in
        which objects could be labelled, if not everywhere."""
        self.write_boxes(agent, "ground_truth", stamp, boxes, ready, key, points, views)
        if flag("truth", "key", key):
            self.agents[agent]["key_frames"].append(nanos("truth", "stamp", stamp))

    def own_labels(self, agent, stamp, boxes, points=None, key=True, ready=None, views=()):
        """What the agent's own side labelled by its own sensors; the rest as in `truth`."""
        self.write_boxes(agent, "own_labels", stamp, boxes, ready, key, points, views)

    def write_views(self, agent, stream, stamp, views, ready):
        if not len(views):
            return
        cdr = Cdr(stamp, f"{agent}/body")
        for name, dtype in ("pose", "<f8"), ("focal", "<f8"), ("center", "<f8"), ("size", "<u4"), ("margin", "<f8"):
            cdr.array([v[name] for v in views], dtype)
        self.write(agent, stream + "_views", "realo_msgs/Views", stamp, ready, cdr)

    def write_boxes(self, agent, stream, stamp, b, ready, key, points, views=()):
        sweeps, where, frame = self.known(agent)["sweeps"], f"{stream} of `{agent}` at {stamp}", f"{agent}/body"
        stamp, key = self.stamp(where, stamp), flag(where, "key", key)
        ready, given = self.ready(where, stamp, ready), set(boxes([], [], [], []))
        if not isinstance(b, dict) or set(b) != given:
            refuse(where, "boxes", "what boxes(...) gives", f"{b!r}"[:80], "pass boxes(center, size, yaw, classes)")
        made = {"pose", "focal", "center", "size", "margin"}
        if not isinstance(views, (list, tuple)) or not all(isinstance(one, dict) and set(one) == made for one in views):
            refuse(where, "views", "a list of what view(...) gives", f"{views!r}"[:80], "pass [view(...), ...]")
        b = boxes(**b, where=where)
        if points is not None:
            points = whole(where, "points", column_of(where, "points", points, len(b["classes"])), 0, 2**32 - 1)
        self.once(where, agent, stream, stamp)
        self.write_views(agent, stream, stamp, views, ready)
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
            cdr.text(b["track"][i])
        # Boxes of no sweep have the largest number.
        info.put("QB", sweeps.get(stamp, 2**64 - 1), key)
        for column in [], b["yaw"], b["velocity"], []:
            info.array(column, "<f8")
        info.put("I", int(points is not None))
        if points is not None:
            info.text(agent)
        info.array([] if points is None else points, "<u4")
        self.write(agent, stream, "vision_msgs/Detection3DArray", stamp, ready, cdr)
        self.write(agent, stream + "_info", "realo_msgs/BoxesInfo", stamp, ready, info)

    def write(self, agent, stream, schema, stamp, ready, cdr):
        where = f"{stream} of `{agent}` at {stamp}"
        if self.file.closed:
            refuse(where, "log", "a log that is open", "one that was closed", "write all before `close` or the end of `with`")
        ready = self.ready(where, stamp, ready)
        bulk, topic = stream == "points", "/tf_static" if stream == "tf_static" else f"/{agent}/{stream}"
        chunk = self.open[bulk] = self.open[bulk] or {"data": bytearray(), "index": {}}
        if topic not in self.channels:
            chunk["data"] += self.define(topic, schema)
        channel = self.channels[topic]
        head = struct.pack("<HIQQ", channel["id"], channel["count"], ready, stamp)
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
        """Writes what is left and the index, and gives the file its name."""
        if self.file.closed:
            return
        try:
            self.finish()
        except BaseException:
            self.discard()
            raise
        if self.partial:
            os.replace(self.partial, self.path)

    def finish(self):
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
