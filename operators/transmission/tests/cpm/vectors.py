"""Makes or checks the CPMs of tests/corpus/cpm by an encoder that has nothing to do with ours, and what tests expect of them.

    pip install asn1tools pyproj
    python vectors.py MODULES            # writes ../corpus/cpm/*.uper and vectors.json
    python vectors.py MODULES --check    # makes them again, compares, and decodes what is kept

MODULES: the folder with ETSI's cdd_2_2_1.asn and cpm_2_1_1.asn, such as autogen/asn.1 of the crate c-its-parser.
Bits are asn1tools', geodesy is PROJ's; nothing here is computed as the crate does it.
"""

import json
import math
import pathlib
import sys

import asn1tools
import pyproj

HERE = pathlib.Path(__file__).parent
CORPUS = HERE.parent / "corpus" / "cpm"

# 2025-12-31 23:59:59.900 UTC and an exact stamp 0.3 ms later; leap seconds since 2004: 5.
EPOCH = 1_072_915_200
STAMP = 1_767_225_599_900_300_000
TIME = 1_767_225_599_900 - EPOCH * 1000 + 5_000

CAR, TRUCK = ("vehicleSubClass", 5), ("vehicleSubClass", 8)
PEDESTRIAN = ("vruSubClass", ("pedestrian", 0))
NO_ELLIPSE = {"semiMajorConfidence": 4095, "semiMinorConfidence": 4095, "semiMajorOrientation": 3601}
CODES = {"vehicle": CAR, "truck": TRUCK, "pedestrian": PEDESTRIAN, "Bus": ("vehicleSubClass", 6), "sofa": ("otherSubClass", 0)}


def modules(folder):
    cdd, cpm = [(pathlib.Path(folder) / name).read_text(encoding="utf-8", errors="replace") for name in ("cdd_2_2_1.asn", "cpm_2_1_1.asn")]
    # asn1tools takes a union of named numbers for its first member; 14 is the largest one.
    union = "TrafficParticipantType (unknown|passengerCar..tram|agricultural)"
    if union not in cdd:
        sys.exit(f"{folder}/cdd_2_2_1.asn: expected `{union}`: another release of the common data dictionary?")
    return asn1tools.compile_string(cdd.replace(union, "TrafficParticipantType (0..14)") + cpm, "uper")


def fnv1a(name):
    number = 0x811C9DC5
    for byte in name.encode():
        number = (number ^ byte) * 0x01000193 % 2**32
    return number


class Local:
    """East, north and up of a place on WGS84."""

    def __init__(self, latitude, longitude, height):
        place = f"+lat_0={latitude!r} +lon_0={longitude!r} +h_0={height!r}"
        self.way = pyproj.Transformer.from_pipeline(
            f"+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart +ellps=WGS84 +step +proj=topocentric +ellps=WGS84 {place}"
        )

    def of(self, longitude, latitude, height):
        return self.way.transform(longitude, latitude, height)

    def place(self, point):
        return self.way.transform(*point, direction="INVERSE")


def turned(yaw, x, y):
    return x * math.cos(yaw) - y * math.sin(yaw), x * math.sin(yaw) + y * math.cos(yaw)


def coordinate(value, confidence=4096):
    return {"value": value, "confidence": confidence}


def angle(value, confidence=127):
    return {"value": value, "confidence": confidence}


def size(value):
    return {"value": value, "confidence": 32}


def speed(value):
    return {"value": value, "confidence": 127}


def cpm(codec, station, time, position, containers, **management):
    def data(number, content):
        kinds = {
            1: "OriginatingVehicleContainer",
            2: "OriginatingRsuContainer",
            3: "SensorInformationContainer",
            4: "PerceptionRegionContainer",
            5: "PerceivedObjectContainer",
        }
        return codec.encode(kinds[number], content, check_constraints=True)

    message = {
        "header": {"protocolVersion": 2, "messageId": 14, "stationId": station},
        "payload": {
            "managementContainer": {"referenceTime": time, "referencePosition": position, **management},
            "cpmContainers": [{"containerId": number, "containerData": data(number, content)} for number, content in containers],
        },
    }
    return codec.encode("CollectivePerceptionMessage", message, check_constraints=True)


def position(latitude, longitude, altitude):
    return {
        "latitude": latitude,
        "longitude": longitude,
        "positionConfidenceEllipse": NO_ELLIPSE,
        "altitude": {"altitudeValue": altitude, "altitudeConfidence": "unavailable"},
    }


def objects(found, number=None):
    return 5, {"numberOfPerceivedObjects": len(found) if number is None else number, "perceivedObjects": found}


def box(center, extents, yaw, name, score, velocity=None, track=None, covariance=None):
    return {
        "center": center,
        "extents": extents,
        "yaw": yaw,
        "velocity": velocity,
        "class": name,
        "score": score,
        "track": track,
        "covariance": covariance,
    }


# What our encoder is given, and must make the very bytes of.
OURS = {
    "vehicle": {
        "agent": "cav2",
        "seq": 41,
        "origin": [48.1374, 11.5755, 519.0],
        "pose": [412.318, -87.642, 1.207, 0.6],
        "boxes": [
            box([12.34, -3.21, 0.79], [4.52, 1.93, 1.56], 0.3, "vehicle", 0.873, velocity=[11.3, -0.4, 0.0], track=17),
            box([-31.07, 8.88, 0.86], [0.62, 0.58, 1.74], -2.9, "pedestrian", 0.412),
            box([55.5, 20.25, 1.61], [9.87, 2.51, 3.22], 1.5, "truck", 0.999),
            box([3.0, 60.02, 1.5], [11.96, 2.54, 3.01], 3.1, "Bus", 0.004, covariance=[0.04, 0.09, 0.0012]),
            box([-8.42, -17.7, 0.4], [2.07, 0.91, 0.82], 0.0, "sofa", 0.5),
        ],
    },
    "roadside": {
        "agent": "rsu1",
        "roadside": "rsu1,rsu2",
        "seq": 65_535,
        "origin": [-33.8688, -70.6693, 567.25],
        "pose": [-2_904.4, -7_811.9, 12.4, -2.2],
        "boxes": [box([40.04, 1.03, -4.12], [4.21, 1.84, 1.47], -1.1, "vehicle", 0.66, velocity=[-7.77, 2.22, 0.11])],
    },
    "antimeridian": {
        "agent": "station-4294967295",
        "seq": 0,
        "origin": [-17.0, 179.9999, 0.0],
        "pose": [30.0, 5.0, 0.0, 3.0],
        "boxes": [box([-40.33, 3.07, 0.72], [4.4, 1.8, 1.5], 1.2, "vehicle", 0.25)],
    },
    "empty": {"agent": "cav1", "seq": 3, "origin": [0.0, 0.0, 0.0], "pose": [1.0, 2.0, 0.0, 0.0], "boxes": []},
}


def ours(codec, case):
    """The CPM of a case, by the rules that docs/reference/packets.md states."""
    there = Local(*case["origin"])
    x, y, z, yaw = case["pose"]
    longitude, latitude, height = there.place((x, y, z))
    latitude, longitude, altitude = round(latitude * 1e7), round(longitude * 1e7), round(height * 100)
    here = Local(latitude * 1e-7, longitude * 1e-7, altitude * 0.01)

    def moved(point):
        across, along = turned(yaw, point[0], point[1])
        return here.of(*there.place((x + across, y + along, z + point[2])))

    def direction(at, way):
        start, end = moved(at), moved([a + w for a, w in zip(at, way)])
        return [b - a for a, b in zip(start, end)]

    def tenths(radians):
        return round(math.degrees(radians) * 10) % 3600

    taken, found = {b["track"] for b in case["boxes"]}, []
    for index, given in enumerate(case["boxes"]):
        known = given["track"] is not None and given["track"] < 65_536
        number = given["track"] if known else (256 * case["seq"] + sum("objectAge" in o for o in found)) % 65_536
        assert known or number not in taken, "choose another track"
        center, yaws = moved(given["center"]), direction(given["center"], [math.cos(given["yaw"]), math.sin(given["yaw"]), 0])
        confidence = [4096, 4096, 127]
        if given["covariance"]:
            xx, yy, aa = given["covariance"]
            c, s = math.cos(yaw), math.sin(yaw)
            deviations = [math.sqrt(c * c * xx + s * s * yy), math.sqrt(s * s * xx + c * c * yy), math.degrees(math.sqrt(aa))]
            confidence = [math.ceil(1.959963985 * d / unit) for d, unit in zip(deviations, (0.01, 0.01, 0.1))]
        length, width, height = given["extents"]
        thing = {
            "objectId": number,
            "measurementDeltaTime": 0,
            "position": {
                "xCoordinate": coordinate(round(center[0] * 100), confidence[0]),
                "yCoordinate": coordinate(round(center[1] * 100), confidence[1]),
                "zCoordinate": coordinate(round(center[2] * 100)),
            },
            "angles": {"zAngle": angle(tenths(math.atan2(yaws[1], yaws[0])), confidence[2])},
            "objectDimensionZ": size(round(height * 10)),
            "objectDimensionY": size(round(width * 10)),
            "objectDimensionX": size(round(length * 10)),
            "classification": [{"objectClass": CODES[given["class"]], "confidence": max(1, round(given["score"] * 100))}],
        }
        if given["velocity"]:
            way = direction(given["center"], given["velocity"])
            thing["velocity"] = ("cartesianVelocity", {k: speed(round(v * 100)) for k, v in zip(("xVelocity", "yVelocity", "zVelocity"), way)})
        if not known:
            thing["objectAge"] = 0
        found.append(thing)
    if case["agent"] in case.get("roadside", "").split(","):
        origin = (2, {})
    else:
        ahead = direction([0, 0, 0], [1, 0, 0])
        origin = (1, {"orientationAngle": angle(tenths(math.atan2(ahead[0], ahead[1])))})
    station = int(case["agent"][8:]) if case["agent"].startswith("station-") else fnv1a(case["agent"])
    return cpm(codec, station, TIME, position(latitude, longitude, altitude), [origin, objects(found)])


def thing(x, y, **more):
    return {"measurementDeltaTime": 0, "position": {"xCoordinate": coordinate(x), "yCoordinate": coordinate(y)}, **more}


def sized(length, width, height=None):
    dimensions = {"objectDimensionX": size(length), "objectDimensionY": size(width)}
    return dimensions if height is None else {**dimensions, "objectDimensionZ": size(height)}


def classified(*classes):
    return {"classification": [{"objectClass": kind, "confidence": confidence} for kind, confidence in classes]}


def turn(value):
    return {"angles": {"zAngle": angle(value)}}


SENSOR = {"sensorId": 1, "sensorType": 2, "shadowingApplies": True}
RADIAL = ("radial", {"range": 1000, "horizontalOpeningAngleStart": 0, "horizontalOpeningAngleEnd": 3599})
REGION = {"measurementDeltaTime": 0, "perceptionRegionConfidence": 80, "perceptionRegionShape": RADIAL, "shadowingApplies": False}
POLAR = {
    "velocityMagnitude": {"speedValue": 1000, "speedConfidence": 50},
    "velocityDirection": angle(900),
}
NOWHERE = {"value": -131072, "confidence": 4096}


def theirs(codec):
    """CPMs as other stacks send them: bytes, and what is expected of them about an origin at the reference position."""
    here = position(523_456_789, 134_567_890, 12_345)
    full = thing(
        1000,
        -2000,
        objectId=65_535,
        velocity=("cartesianVelocity", {"xVelocity": speed(-1500), "yVelocity": speed(0)}),
        acceleration=("polarAcceleration", {
            "accelerationMagnitude": {"accelerationMagnitudeValue": 10, "accelerationConfidence": 102},
            "accelerationDirection": angle(3600 - 900),
        }),
        zAngularVelocity={"value": -255, "confidence": "unavailable"},
        lowerTriangularCorrelationMatrices=[{
            "componentsIncludedIntheMatrix": (b"\xc0\x00", 13),
            "matrix": [[-50]],
        }],
        objectAge=1500,
        objectPerceptionQuality=15,
        sensorIdList=[1, 7],
        mapPosition={"laneId": 3, "longitudinalLanePosition": {"longitudinalLanePositionValue": 100, "longitudinalLanePositionConfidence": 1023}},
        **turn(1800),
        **sized(83, 25, 31),
        **classified((CAR, 20), (TRUCK, 75), (("otherSubClass", 1), 5)),
    )
    full["position"] = {"xCoordinate": coordinate(1000, 20), "yCoordinate": coordinate(-2000, 4095), "zCoordinate": coordinate(155, 4096)}
    full["angles"]["yAngle"] = angle(10)
    group = ("groupSubClass", {"clusterId": 3, "clusterCardinalitySize": 5, "clusterProfiles": (b"\x80", 4)})
    cases = {
        "everything": (
            [(3, [SENSOR]), (4, [REGION]), (1, {"orientationAngle": angle(450, 10), "pitchAngle": angle(5)}), objects([full], 9)],
            {"segmentationInfo": {"totalMsgNo": 3, "thisMsgNo": 2}},
            [box([10, -20, 1.55], [8.3, 2.5, 3.1], math.pi, "truck", 0.75, velocity=[-15, 0, 0], track=65_535)],
            [0, 0, 2, 1],
        ),
        "sparse": (
            [objects([
                # 0.1 s before the reference time at 10 m/s north; faces where it goes; no height over ground, no class.
                {**thing(500, 500, velocity=("polarVelocity", POLAR), objectPerceptionQuality=12, **sized(45, 18, 15)), "measurementDeltaTime": -100},
                # A pedestrian that stands: nothing of an angle, a height or a confidence.
                thing(-700, 0, objectId=5, **sized(6, 6), **classified((("vruSubClass", ("pedestrian", 3)), 101))),
                thing(0, 900, objectAge=0, objectId=6, **turn(3600), **sized(30, 10, 12), **classified((group, 40))),
                thing(0, -900, **turn(2700), **sized(254, 1, 254), **classified((("vehicleSubClass", 0), 100))),
            ])],
            {},
            [
                box([5, 6, 0.75], [4.5, 1.8, 1.5], math.pi / 2, "unknown", 0.8, velocity=[0, 10, 0]),
                box([-7, 0, 0.85], [0.6, 0.6, 1.7], 0, "pedestrian", 0.5, track=5),
                box([0, 9, 0.6], [3, 1, 1.2], 0, "unknown", 0.4),
                box([0, -9, 12.7], [25.4, 0.1, 25.4], -math.pi / 2, "unknown", 1.0),
            ],
            [0, 4, 0, 0],
        ),
        "unusable": (
            [(2, {}), objects([
                thing(0, 0, **turn(0), **classified((CAR, 90))),
                thing(0, 0, **turn(0), **sized(255, 20, 15), **classified((CAR, 90))),
                thing(0, 0, **turn(0), **sized(45, 256, 15), **classified((CAR, 90))),
                thing(0, 0, **turn(3601), **sized(45, 18, 15), **classified((CAR, 90))),
                {**thing(0, 0, **turn(0), **sized(45, 18, 15), **classified((CAR, 90))), "measurementDeltaTime": -2048},
                {**thing(0, 0, **turn(0), **sized(45, 18, 15)), "position": {"xCoordinate": NOWHERE, "yCoordinate": coordinate(0)}},
                thing(0, 0, velocity=("cartesianVelocity", {"xVelocity": speed(16_383), "yVelocity": speed(0)}), **sized(45, 18, 15)),
            ])],
            {},
            [],
            [7, 0, 0, 0],
        ),
        "nothing": ([(1, {"orientationAngle": angle(3601)})], {"messageRateRange": {
            "messageRateMin": {"mantissa": 1, "exponent": 0}, "messageRateMax": {"mantissa": 10, "exponent": 0},
        }}, [], [0, 0, 0, 0]),
    }
    for name, (containers, management, boxes, unused) in cases.items():
        data = cpm(codec, 4_711, TIME, here, containers, **management)
        yield name, data, {"agent": "station-4711", "origin": [52.3456789, 13.456789, 123.45], "boxes": boxes, "unused": unused}
    # Without a height it is that of the origin.
    data = cpm(codec, 4_711, TIME, position(523_456_789, 134_567_890, 800_001), [objects([full])])
    high = box([10, -20, 1.55], [8.3, 2.5, 3.1], math.pi, "truck", 0.75, velocity=[-15, 0, 0], track=65_535)
    yield "no_altitude", data, {"agent": "station-4711", "origin": [52.3456789, 13.456789, 77.0], "boxes": [high], "unused": [0, 0, 0, 0]}


def main():
    if len(sys.argv) not in (2, 3) or sys.argv[2:] not in ([], ["--check"]):
        sys.exit(__doc__)
    codec = modules(sys.argv[1])
    files, reported = {}, {"stamp": STAMP, "ours": [], "theirs": []}
    for name, case in OURS.items():
        files[name] = ours(codec, case)
        reported["ours"].append({"name": name, "roadside": "", **case})
    for name, data, case in theirs(codec):
        files[name] = data
        reported["theirs"].append({"name": name, **case})
    for name, data in files.items():
        message = codec.decode("CollectivePerceptionMessage", data)
        assert codec.encode("CollectivePerceptionMessage", message) == data, name
        for container in message["payload"]["cpmContainers"]:
            if container["containerId"] == 5:
                content = codec.decode("PerceivedObjectContainer", container["containerData"])
                assert codec.encode("PerceivedObjectContainer", content) == container["containerData"], name
    text = json.dumps(reported, indent=1) + "\n"
    if sys.argv[2:]:
        kept = {path.stem: path.read_bytes() for path in CORPUS.glob("*.uper")}
        wrong = sorted(name for name in files if kept.get(name) != files[name])
        wrong += [] if (HERE / "vectors.json").read_text() == text else ["vectors.json"]
        sys.exit(f"expected what is made here, found others: {', '.join(wrong)}" if wrong else None)
    CORPUS.mkdir(parents=True, exist_ok=True)
    for name, data in files.items():
        (CORPUS / f"{name}.uper").write_bytes(data)
    (HERE / "vectors.json").write_text(text)


if __name__ == "__main__":
    main()
