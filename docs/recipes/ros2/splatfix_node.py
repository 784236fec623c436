# Not run: needs ROS 2. tests/test_recipes.py runs the conversions in ros_poses.py.
"""ROS 2 node: localizes camera images; publishes the pose, and `map -> odom` so that the robot is where it was seen.

Beside it lie ros_poses.py and splatfix_client.py, a copy of service/client.py.
"""

import threading

import numpy as np
import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from rclpy.time import Time
from ros_poses import covariance_of, intrinsics_of, map_from_odom, pose_of
from sensor_msgs.msg import CameraInfo, CompressedImage
from splatfix_client import Client, Intrinsics, ServiceError
from tf2_ros import Buffer, TransformBroadcaster, TransformException, TransformListener


class Splatfix(Node):
    """One photo at a time: the newest image once the answer to the one before has come."""

    def __init__(self):
        super().__init__("splatfix")
        given = {"url": "http://127.0.0.1:8000", "key": "", "scene": "studio", "metres_per_unit": 1.0,
                 "map_frame": "map", "odom_frame": "odom"}  # fmt: skip
        self.given = {name: self.declare_parameter(name, value).value for name, value in given.items()}
        self.client = Client(self.given["url"], self.given["key"])
        self.camera = None
        self.busy = threading.Lock()
        # 30 s: the transform is asked for the image's own stamp, after the answer.
        self.buffer = Buffer(cache_time=Duration(seconds=30))
        self.listener = TransformListener(self.buffer, self)
        self.broadcaster = TransformBroadcaster(self)
        self.poses = self.create_publisher(PoseWithCovarianceStamped, "splatfix/pose", 10)
        self.create_subscription(CameraInfo, "camera_info", self.keep_camera, qos_profile_sensor_data)
        self.create_subscription(CompressedImage, "image/compressed", self.localize, qos_profile_sensor_data)

    def keep_camera(self, info):
        self.camera = intrinsics_of(info.width, info.height, info.k, info.distortion_model, info.d)

    def localize(self, image):
        if self.camera is not None and self.busy.acquire(blocking=False):
            threading.Thread(target=self.answer, args=(image, self.camera), daemon=True).start()

    def answer(self, image, camera):
        try:
            known = Intrinsics(**{**camera, "distortion": tuple(camera.get("distortion", ()))})
            result = self.client.localize(bytes(image.data), scene=self.given["scene"], intrinsics=known, timeout_s=25)
            if result.localized:
                self.publish(image.header, result)
            else:
                self.get_logger().info(f"{result.status}: {result.reason}. {result.hint}")
        except (ServiceError, TransformException) as error:
            self.get_logger().warning(str(error))
        finally:
            self.busy.release()

    def publish(self, header, result):
        scale, pose = self.given["metres_per_unit"], result.pose.world_from_camera.copy()
        metric = pose.copy()
        metric[:3, 3] *= scale
        if result.covariance is not None:
            said = PoseWithCovarianceStamped()
            said.header.stamp, said.header.frame_id = header.stamp, self.given["map_frame"]
            fill(said.pose.pose.position, said.pose.pose.orientation, metric)
            said.pose.covariance = covariance_of(pose, result.covariance, scale)
            self.poses.publish(said)
        stamp, odom = Time.from_msg(header.stamp), self.given["odom_frame"]
        found = self.buffer.lookup_transform(odom, header.frame_id, stamp, Duration(seconds=1)).transform
        correction = TransformStamped()
        correction.header.stamp = self.get_clock().now().to_msg()
        correction.header.frame_id, correction.child_frame_id = self.given["map_frame"], odom
        moved = map_from_odom(pose, matrix_of(found), scale)
        fill(correction.transform.translation, correction.transform.rotation, moved)
        self.broadcaster.sendTransform(correction)


def fill(position, orientation, matrix):
    """Set a message's position and orientation."""
    (position.x, position.y, position.z), rotation = pose_of(matrix)
    orientation.x, orientation.y, orientation.z, orientation.w = rotation


def matrix_of(transform):
    """Return a Transform message as a 4x4."""
    q, t = transform.rotation, transform.translation
    x, y, z, w = q.x, q.y, q.z, q.w
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y), t.x],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x), t.y],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y), t.z],
            [0, 0, 0, 1],
        ]
    )


def main():
    """Run until the process is stopped."""
    rclpy.init()
    rclpy.spin(Splatfix())


if __name__ == "__main__":
    main()
