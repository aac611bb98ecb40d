"""Asks a server of Foxglove's protocol for all channels, and decodes what comes by the schemas that it sends.

    client.py HOST PROTOCOL TOPIC...

Ends once every topic has come, and says as JSON what it saw.
"""

import asyncio
import json
import struct
import sys

import websockets
from mcap.records import Schema
from mcap_ros2.decoder import DecoderFactory

PATIENCE_S = 120
MESSAGE_DATA, TIME = 1, 2


class Client:
    def __init__(self):
        self.info, self.channels, self.by_subscription = None, {}, {}
        self.factory = DecoderFactory()
        self.seen, self.time, self.time_ran_back = {}, None, False
        self.points = self.boxes = self.cubes = 0

    async def text(self, socket, text):
        said = json.loads(text)
        if said["op"] == "serverInfo":
            self.info = said
        elif said["op"] == "advertise":
            asked = []
            for channel in said["channels"]:
                number = channel["id"]
                schema = Schema(number, channel["schema"].encode(), channel["schemaEncoding"], channel["schemaName"])
                decode = self.factory.decoder_for(channel["encoding"], schema)
                assert decode is not None, channel
                self.channels[number] = channel["topic"], channel["schemaName"]
                # Another number than the channel's.
                self.by_subscription[1000 + number] = number, decode
                asked.append({"id": 1000 + number, "channelId": number})
            await socket.send(json.dumps({"op": "subscribe", "subscriptions": asked}))
        elif said["op"] == "unadvertise":
            for number in said["channelIds"]:
                del self.channels[number], self.by_subscription[1000 + number]

    def bytes(self, data):
        if data[0] == TIME:
            (time,) = struct.unpack_from("<Q", data, 1)
            self.time_ran_back |= self.time is not None and time < self.time
            self.time = time
            return
        assert data[0] == MESSAGE_DATA, data[0]
        subscription, _ = struct.unpack_from("<IQ", data, 1)
        number, decode = self.by_subscription[subscription]
        topic, schema = self.channels[number]
        message = decode(data[13:])
        self.seen[topic] = self.seen.get(topic, 0) + 1
        if schema == "sensor_msgs/msg/PointCloud2":
            assert len(message.data) == message.width * message.height * message.point_step, topic
            self.points += message.width * message.height
        elif topic.endswith("/boxes"):
            self.boxes += len(message.detections)
            assert all(box.bbox.size.x > 0 for box in message.detections)
        elif topic.endswith("/boxes_scene"):
            (entity,) = message.entities
            self.cubes += len(entity.cubes)
            assert entity.frame_id.endswith("/body") and len(entity.lines) == len(entity.texts) == len(entity.cubes)


async def main(host, protocol, topics):
    client = Client()
    async with websockets.connect(f"ws://{host}", subprotocols=[protocol], max_size=None) as socket:
        assert socket.subprotocol == protocol, socket.subprotocol
        while not set(topics) <= set(client.seen) or not client.cubes:
            received = await socket.recv()
            if isinstance(received, str):
                await client.text(socket, received)
            else:
                client.bytes(received)
    print(json.dumps({
        "info": client.info, "channels": dict(client.channels.values()), "seen": client.seen, "points": client.points,
        "boxes": client.boxes, "cubes": client.cubes, "time": client.time, "time_ran_back": client.time_ran_back,
    }))


asyncio.run(asyncio.wait_for(main(sys.argv[1], sys.argv[2], sys.argv[3:]), PATIENCE_S))
