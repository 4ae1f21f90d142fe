# SPDX-License-Identifier: Apache-2.0
"""Publish the messages of a bag as they stand in it: `publish_bag.py BAG SECONDS_BETWEEN_IMAGE_SETS`.

Waits until somebody subscribes to every topic, and after the last message until it is ended.
"""

import sys
import time
from pathlib import Path

import rclpy
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile

from flowing_puppet_ros.bag.reader import open_bag
from flowing_puppet_ros.node.factory import message_type


def main(path: Path, pause: float) -> None:
    """Publish the bag in log order, with a pause wherever the log time moves on by more than 20 ms."""
    rclpy.init()
    node = Node("publish_bag")
    with open_bag(path) as bag:
        publishers = {
            topic: node.create_publisher(
                message_type(kind),
                topic,
                QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
                if topic == "/tf_static"
                else QoSProfile(depth=100),
            )
            for topic, kind in bag.topics.items()
        }
        while not all(publisher.get_subscription_count() for publisher in publishers.values()):
            time.sleep(0.1)
        # The other side of a match may learn of it a little later.
        time.sleep(2.0)
        last = None
        for record in bag.messages():
            if last is not None and record.log_time - last > 20_000_000:
                time.sleep(pause)
            last = record.log_time
            publishers[record.topic].publish(bytes(record.raw))
    while True:
        time.sleep(1.0)


if __name__ == "__main__":
    try:
        main(Path(sys.argv[1]), float(sys.argv[2]))
    except KeyboardInterrupt:
        rclpy.try_shutdown()
