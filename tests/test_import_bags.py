"""Bags written by others' libraries give the views that the same arrays give; what is wrong in a bag is named."""

from __future__ import annotations

import base64
import json
import shutil
import struct

import cv2
import numpy as np
import pytest

from tests.test_importing import SHAPE, TOF, imported, scenes
from tofcapture.errors import PassedOver, TofError
from tofcapture.files.view import find_views, open_view
from tofcapture.importing.said import Said
from tofcapture.importing.views import import_data

rosbag2 = pytest.importorskip("rosbags.rosbag2", reason="rosbags is not installed")
from rosbags.rosbag1 import Writer as Writer1  # noqa: E402
from rosbags.typesys import Stores, get_types_from_msg, get_typestore  # noqa: E402

S = 10**9
START = 1_700_000_000 * S
TF = "geometry_msgs/TransformStamped[] transforms"
STORES = {"1": get_typestore(Stores.ROS1_NOETIC), "2": get_typestore(Stores.ROS2_HUMBLE)}
STORES["1"].register(get_types_from_msg(TF, "tf2_msgs/msg/TFMessage"))
FORMS = ("sqlite3", "mcap", "ros1", "json")
FOXGLOVE = {  # fields of its messages in protobuf
    "RawImage": "timestamp:Timestamp frame_id:s width:u height:u encoding:s step:u data:b",
    "CameraCalibration": "timestamp:Timestamp frame_id:s width:u height:u distortion_model:s D:d* K:d* R:d* P:d*",
    "FrameTransforms": "transforms:FrameTransform*",
    "FrameTransform": "timestamp:Timestamp parent_frame_id:s child_frame_id:s translation:Vector3 rotation:Quaternion",
    "Vector3": "x:d y:d z:d", "Quaternion": "x:d y:d z:d w:d",
}  # fmt: skip


def protobuf():
    """What encodes Foxglove's messages, and their definition as an MCAP file holds it."""
    pb2 = pytest.importorskip("google.protobuf.descriptor_pb2", reason="protobuf is not installed")
    from google.protobuf import json_format, message_factory, timestamp_pb2

    file = pb2.FileDescriptorProto(name="foxglove.proto", package="foxglove", syntax="proto3")
    file.dependency.append("google/protobuf/timestamp.proto")
    for name, fields in FOXGLOVE.items():
        message = file.message_type.add(name=name)
        for number, (field, kind) in enumerate((f.split(":") for f in fields.split()), start=1):
            of = kind.rstrip("*")
            number_of = {"s": 9, "u": 13, "b": 12, "d": 1}.get(of, 11)
            package = "google.protobuf" if of == "Timestamp" else "foxglove"
            more = {"type_name": f".{package}.{of}"} if number_of == 11 else {}
            message.field.add(name=field, number=number, type=number_of, label=3 if kind != of else 1, **more)
    stamp = pb2.FileDescriptorProto()
    timestamp_pb2.DESCRIPTOR.CopyToProto(stamp)
    kinds = message_factory.GetMessages([stamp, file])

    def encode(name, told):
        return json_format.ParseDict(told, kinds[f"foxglove.{name}"]()).SerializeToString()

    return encode, pb2.FileDescriptorSet(file=[stamp, file]).SerializeToString()


class Bag:
    """Messages of one of the forms, with ROS's own type descriptions."""

    def __init__(self, path, form):
        self.path, self.form = path, form
        self.store = STORES["1" if form in {"ros1", "mcap-ros1"} else "2"]
        self.rows = []  # topic, type, time of recording, message

    def kind(self, name):
        return self.store.types[name]

    def header(self, time, frame):
        stamp = self.kind("builtin_interfaces/msg/Time")(sec=time // S, nanosec=time % S)
        more = {"seq": 0} if self.store is STORES["1"] else {}
        return self.kind("std_msgs/msg/Header")(stamp=stamp, frame_id=frame, **more)

    def add(self, topic, kind, time, received=None, **fields):
        message = self.kind(kind)(**fields)
        self.rows.append((topic, kind, time if received is None else received, message))

    def image(self, topic, time, array, encoding="16UC1", frame="tof", received=None):
        H, W = array.shape[:2]
        data = np.ascontiguousarray(array).view(np.uint8).ravel()
        head = self.header(time, frame)
        step = data.size // H
        self.add(
            topic, "sensor_msgs/msg/Image", time, received, header=head, height=H, width=W, encoding=encoding,
            is_bigendian=0, step=step, data=data,
        )  # fmt: skip

    def compressed(self, topic, time, data, told, frame="tof"):
        self.add(
            topic,
            "sensor_msgs/msg/CompressedImage",
            time,
            header=self.header(time, frame),
            format=told,
            data=np.frombuffer(data, np.uint8),
        )

    def camera(self, topic, time, shape=SHAPE, frame="tof", fx=None, tof=TOF):
        fx, fy = (tof["fx"], tof["fy"]) if fx is None else (fx, fx)
        K = np.array([fx, 0, tof["cx"], 0, fy, tof["cy"], 0, 0, 1.0])
        names = "DKRP" if self.store is STORES["1"] else "dkrp"
        held = dict(zip(names, (np.zeros(5), K, np.eye(3).ravel(), np.zeros(12)), strict=True))
        roi = self.kind("sensor_msgs/msg/RegionOfInterest")(
            x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
        )
        self.add(
            topic, "sensor_msgs/msg/CameraInfo", time, header=self.header(time, frame), height=shape[0], width=shape[1],
            distortion_model="plumb_bob", binning_x=0, binning_y=0, roi=roi, **held,
        )  # fmt: skip

    def tf(self, time, parent, child, xyz):
        vector = self.kind("geometry_msgs/msg/Vector3")(*map(float, xyz))
        turn = self.kind("geometry_msgs/msg/Quaternion")(0.0, 0.0, 0.0, 1.0)
        link = self.kind("geometry_msgs/msg/Transform")(vector, turn)
        one = self.kind("geometry_msgs/msg/TransformStamped")(self.header(time, parent), child, link)
        self.add("/tf", "tf2_msgs/msg/TFMessage", time, transforms=[one])

    def pose(self, kind, time, xyz, frame="world", child=""):
        """A pose turned by 90 degrees about z, as PoseStamped, Odometry or TransformStamped."""
        half, name = np.sqrt(0.5), f"geometry_msgs/msg/{kind}"
        point = self.kind("geometry_msgs/msg/Point")(*map(float, xyz))
        turn, head = self.kind("geometry_msgs/msg/Quaternion")(0.0, 0.0, half, half), self.header(time, frame)
        pose = self.kind("geometry_msgs/msg/Pose")(point, turn)
        if kind == "PoseStamped":
            self.add("/tracker", name, time, header=head, pose=pose)
        elif kind == "TransformStamped":
            link = self.kind("geometry_msgs/msg/Transform")(
                self.kind("geometry_msgs/msg/Vector3")(*map(float, xyz)), turn
            )
            self.add("/vicon", name, time, header=head, child_frame_id=child, transform=link)
        else:
            zero = self.kind("geometry_msgs/msg/Vector3")(0.0, 0.0, 0.0)
            twist = self.kind("geometry_msgs/msg/Twist")(zero, zero)
            self.add(
                "/odom", "nav_msgs/msg/Odometry", time, header=head, child_frame_id=child,
                pose=self.kind("geometry_msgs/msg/PoseWithCovariance")(pose, np.zeros(36)),
                twist=self.kind("geometry_msgs/msg/TwistWithCovariance")(twist, np.zeros(36)),
            )  # fmt: skip

    def joints(self, time, angles, names):
        self.add(
            "/joint_states", "sensor_msgs/msg/JointState", time, header=self.header(time, ""), name=list(names),
            position=np.array(angles, float), velocity=np.zeros(0), effort=np.zeros(0),
        )  # fmt: skip

    def cloud(self, topic, time, points, frame="stereo"):
        H, W = points.shape[:2]
        field = self.kind("sensor_msgs/msg/PointField")
        fields = [field(name=n, offset=4 * i, datatype=7, count=1) for i, n in enumerate("xyz")]
        data = np.ascontiguousarray(points, np.float32).view(np.uint8).ravel()
        self.add(
            topic, "sensor_msgs/msg/PointCloud2", time, header=self.header(time, frame), height=H, width=W, fields=fields,
            is_bigendian=False, point_step=12, row_step=12 * W, data=data, is_dense=False,
        )  # fmt: skip

    def write(self):
        if self.form in {"json", "protobuf"}:
            return self._write_foxglove()
        if self.form in {"mcap-ros1", "mcap-cdr"}:
            return self._write_mcap()
        if self.form == "ros1":
            writer = Writer1(self.path.with_suffix(".bag"))
        else:
            plugin = rosbag2.StoragePlugin.MCAP if self.form == "mcap" else rosbag2.StoragePlugin.SQLITE3
            writer = rosbag2.Writer(self.path, version=9, storage_plugin=plugin)
        encode = self.store.serialize_ros1 if self.form == "ros1" else self.store.serialize_cdr
        with writer:
            links = {}
            for topic, kind, time, message in sorted(self.rows, key=lambda r: r[2]):
                if topic not in links:
                    links[topic] = writer.add_connection(topic, kind, typestore=self.store)
                writer.write(links[topic], time, encode(message, kind))
        return self.path.with_suffix(".bag") if self.form == "ros1" else self.path

    def _write_mcap(self):
        """As converters write it: no profile, no index."""
        from mcap.writer import IndexType, Writer

        path, ros1 = self.path.with_suffix(".mcap"), self.form == "mcap-ros1"
        encode = self.store.serialize_ros1 if ros1 else self.store.serialize_cdr
        with path.open("wb") as file:
            writer = Writer(
                file, index_types=IndexType.NONE, repeat_channels=False, use_summary_offsets=False
            )
            writer.start()
            ids = {}
            for topic, kind, time, m in sorted(self.rows, key=lambda r: r[2]):
                name = kind.replace("/msg/", "/") if ros1 else kind
                text = self.store.generate_msgdef(kind, ros_version=1 if ros1 else 2)[0].encode()
                if topic not in ids:
                    schema = writer.register_schema(name, "ros1msg" if ros1 else "ros2msg", text)
                    ids[topic] = writer.register_channel(topic, "ros1" if ros1 else "cdr", schema)
                writer.add_message(ids[topic], time, bytes(encode(m, kind)), time)
            writer.finish()
        return path

    def _write_foxglove(self):
        """As Foxglove's JSON or protobuf, without ROS."""
        from mcap.writer import Writer

        encode, schema = (
            protobuf() if self.form == "protobuf" else (lambda _, told: json.dumps(told).encode(), b"{}")
        )
        path = self.path.with_suffix(".mcap")
        with path.open("wb") as file:
            writer = Writer(file)
            writer.start()
            ids = {}
            for topic, kind, time, m in sorted(self.rows, key=lambda r: r[2]):
                name = {
                    "Image": "RawImage",
                    "CameraInfo": "CameraCalibration",
                    "TFMessage": "FrameTransforms" if self.form == "protobuf" else "FrameTransform",
                }[kind.split("/")[-1]]
                head = getattr(m, "header", None) or m.transforms[0].header
                told = {
                    "timestamp": {"sec": head.stamp.sec, "nsec": head.stamp.nanosec},
                    "frame_id": head.frame_id,
                }
                if name == "RawImage":
                    told |= {k: getattr(m, k) for k in ("height", "width", "encoding", "step")}
                    told["data"] = base64.b64encode(m.data.tobytes()).decode()
                elif name == "CameraCalibration":
                    told |= {"height": m.height, "width": m.width, "distortion_model": m.distortion_model}
                    told |= {n.upper(): getattr(m, n).tolist() for n in "dkrp"}
                else:
                    one = m.transforms[0]
                    told |= {"parent_frame_id": head.frame_id, "child_frame_id": one.child_frame_id}
                    told["translation"] = {c: getattr(one.transform.translation, c) for c in "xyz"}
                    told["rotation"] = {c: getattr(one.transform.rotation, c) for c in "xyzw"}
                if topic not in ids:
                    of = "jsonschema" if self.form == "json" else self.form
                    ids[topic] = writer.register_channel(
                        topic, self.form, writer.register_schema(f"foxglove.{name}", of, schema)
                    )
                if self.form == "protobuf":
                    told["timestamp"] = f"{np.datetime64(time, 'ns')}Z"
                    if name == "FrameTransforms":
                        del told["frame_id"]
                    told = {"transforms": [told]} if name == "FrameTransforms" else told
                writer.add_message(ids[topic], time, encode(name, told), time)
            writer.finish()
        return path


def written(path, form="sqlite3", raw="stacked", views=3, change=None):
    """A bag of some views: raw images once or in eight topics, depth in metres, a camera that moves."""
    bag = Bag(path, form)
    taps, depths = scenes(views)
    for i in range(views):
        time = START + i * S // 10
        bag.camera("/tof/camera_info", time)
        if raw == "stacked":
            bag.image("/tof/raw", time, taps[i].reshape(-1, SHAPE[1]))
        for k in range(8) if raw == "topics" else ():
            bag.image(f"/tof/phase_{k}/image_raw", time + k * 1000, taps[i, k])
        for k in range(8) if raw == "turns" else ():
            bag.image("/tof/raw", time + k * 1_000_000, taps[i, k])
        bag.image("/tof/depth", time + 3_000_000, depths[i], "32FC1")
        bag.tf(time - S // 20, "base", "tof", (0.1 * i - 0.05, 0, 0))
        bag.tf(time + S // 20, "base", "tof", (0.1 * i + 0.05, 0, 0))
    if change:
        change(bag)
    return bag.write()


@pytest.mark.parametrize(
    ("form", "raw"),
    [
        *((form, raw) for form in FORMS for raw in ("stacked", "topics", "turns")),
        *((form, "stacked") for form in ("protobuf", "mcap-ros1", "mcap-cdr")),
    ],
)
def test_a_bag_gives_the_views_of_its_arrays(tmp_path, form, raw):
    """Raw taps and depths bit for bit, the intrinsics of CameraInfo, stamps, poses between those of tf."""
    path = written(tmp_path / "mug", form, raw)
    import_data([path], tmp_path / "rec", Said())
    (views,) = find_views(tmp_path / "rec").values()
    taps, depths = scenes(3)
    assert len(views) == 3
    for i, view in enumerate(open_view(p) for p in views):
        np.testing.assert_array_equal(view.tof.raw[0], taps[i])
        np.testing.assert_array_equal(view.stereo.points[..., 2], depths[i])
        assert view.tof.time_ns[0] == START + i * S // 10
        assert (view.tof.info.camera.fx, view.tof.info.camera.cy) == (TOF["fx"], TOF["cy"])
        np.testing.assert_allclose(view.arm_before.T_base_flange[0, 3], 0.1 * i, atol=1e-9)


def test_of_several_cameras_the_one_beside_the_images_is_theirs(tmp_path):
    """Its topic lies in the folder of the images, though another one comes first and says the same frame."""

    def another(bag):
        bag.camera("/a/camera_info", START - S, frame="tof", fx=77.0)

    for view in imported(written(tmp_path / "mug", change=another), tmp_path / "rec", tof={}):
        assert view.tof.info.camera.fx == TOF["fx"]


def test_a_bag_is_its_folder_of_arrays(tmp_path):
    """The same scene as NPY gives identical views, but for times and poses."""
    taps, depths = scenes(3)
    (tmp_path / "mug").mkdir()
    for i in range(3):
        np.save(tmp_path / f"mug/raw_{i}.npy", taps[i])
        np.save(tmp_path / f"mug/depth_{i}.npy", depths[i])
    folder = imported(tmp_path / "mug", tmp_path / "a")
    bags = imported(written(tmp_path / "bag"), tmp_path / "b")
    for one, other in zip(folder, bags, strict=True):
        np.testing.assert_array_equal(one.tof.raw, other.tof.raw)
        np.testing.assert_array_equal(one.stereo.points, other.stereo.points)
        assert one.tof.info.camera == other.tof.info.camera


def test_a_stereo_camera_of_its_own(tmp_path):
    """A slower organised cloud in another frame picks the frames, and tf says how it stands; its clock may be off."""
    bag, (taps, depths) = Bag(tmp_path / "mug", "mcap"), scenes(4)
    for i in range(4):
        time = START + i * S // 10
        bag.camera("/tof/camera_info", time)
        bag.image("/tof/raw", time, taps[i].reshape(-1, SHAPE[1]))
        bag.camera("/stereo/camera_info", time, frame="stereo")
        if i % 2 == 0:
            v, u = np.mgrid[0 : SHAPE[0], 0 : SHAPE[1]]
            x, y = (u - TOF["cx"]) / TOF["fx"], (v - TOF["cy"]) / TOF["fy"]
            bag.cloud("/stereo/points", time - 5 * S, np.stack([x * depths[i], y * depths[i], depths[i]], -1))
    bag.tf(START, "tof", "stereo", (0.001, 0, 0))
    found = imported(bag.write(), tmp_path / "rec", tof={}, truth={"time_offset_s": 5.0})
    assert [v.tof.time_ns[0] for v in found] == [START, START + 2 * S // 10]
    np.testing.assert_array_equal(found[1].stereo.points[..., 2], depths[2])
    np.testing.assert_allclose(found[0].rig.T_tof_stereo[0, 3], 0.001)


def test_compressed_images_and_depths(tmp_path):
    """PNG keeps every bit; compressedDepth keeps millimetres, or inverse depth to its own step."""
    bag, (taps, depths) = Bag(tmp_path / "mug", "sqlite3"), scenes(1)
    bag.camera("/tof/camera_info", START)
    png = cv2.imencode(".png", taps[0].reshape(-1, SHAPE[1]))[1].tobytes()
    bag.compressed("/tof/raw/compressed", START, png, "16UC1; png compressed")
    a, b = 500.0, -20.0
    inverse = cv2.imencode(".png", np.rint(a / depths[0] + b).astype(np.uint16))[1].tobytes()
    bag.compressed(
        "/tof/depth/compressedDepth",
        START,
        struct.pack("<iff", 0, a, b) + inverse,
        "32FC1; compressedDepth png",
    )
    (view,) = imported(bag.write(), tmp_path / "rec", tof={})
    np.testing.assert_array_equal(view.tof.raw[0], taps[0])
    np.testing.assert_allclose(view.stereo.points[..., 2], depths[0], atol=2e-3)


def test_some_lost_messages_are_left_out_aloud(tmp_path):
    """One of ten frames lacks a channel: nine views, and a warning that says so."""

    def loses(bag):
        gone = next(r for r in bag.rows if r[0] == "/tof/phase_3/image_raw" and r[2] > START + S // 2)
        bag.rows.remove(gone)

    path = written(tmp_path / "mug", "mcap", "topics", 10, loses)
    with pytest.warns(PassedOver, match="1 of 10 messages of /tof/phase_0"):
        assert len(imported(path, tmp_path / "rec", tof={})) == 9


UR = ("elbow", "shoulder_lift", "shoulder_pan", "wrist_1", "wrist_2", "wrist_3")  # as ROS sorts them


def posed(kind, offset=0, child="tof", frame="world"):
    """Poses of a moving camera as messages instead of tf, between the frames; a clock that is late by ``offset``."""

    def change(bag):
        bag.rows[:] = [r for r in bag.rows if r[0] != "/tf"]
        for i in range(-1, 5):
            time = START + i * S // 10 - S // 20 - offset
            bag.pose(kind, time, (0.1 * i - 0.05, 0.2, 0.3), frame, child)
            bag.joints(time, [*np.arange(6) + 0.1 * i - 0.05, 0.5], [f"{n}_joint" for n in (*UR, "finger")])

    return change


@pytest.mark.parametrize("form", ["sqlite3", "mcap", "ros1"])
@pytest.mark.parametrize("kind", ["PoseStamped", "Odometry", "TransformStamped"])
def test_messages_of_poses_place_the_camera_and_joints_are_the_arms(tmp_path, form, kind):
    """Between their stamps they are interpolated, with the offset of their clock; joints come in the order from the base on."""
    path = written(tmp_path / "mug", form, change=posed(kind, S // 4))
    found = imported(path, tmp_path / "rec", tof={}, poses={"time_offset_s": 0.25})
    for i, view in enumerate(found):
        T, joints = view.arm_before.T_base_flange, view.arm_before.joints
        np.testing.assert_allclose(T[:3, 3], [0.1 * i, 0.2, 0.3], atol=1e-9)
        np.testing.assert_allclose(T[:3, 0], [0, 1, 0], atol=1e-9)
        np.testing.assert_allclose(joints, np.array([2, 1, 0, 3, 4, 5]) + 0.1 * i, atol=1e-6)


def test_odometry_carries_the_camera_on_its_robot(tmp_path):
    """It moves the frame that tf hangs the camera on."""

    def change(bag):
        posed("Odometry", child="base_link", frame="odom")(bag)
        bag.tf(START, "base_link", "tof", (0.5, 0, 0))

    found = imported(written(tmp_path / "mug", change=change), tmp_path / "rec", tof={})
    np.testing.assert_allclose(found[1].arm_before.T_base_flange[:3, 3], [0.1, 0.7, 0.3], atol=1e-9)


def test_a_topic_of_poses_is_chosen(tmp_path):
    """Two trackers ask which is meant; one that tf leaves unused is told."""

    def two(bag):
        for kind in ("PoseStamped", "TransformStamped"):
            posed(kind, child="helmet")(bag)

    path = written(tmp_path / "mug", change=two)
    with pytest.raises(TofError, match="/tracker, /vicon") as info:
        import_data([path], tmp_path / "rec", Said())
    assert info.value.hint.startswith('[poses] file = "/')
    with pytest.raises(TofError, match="expected PoseStamped or Odometry"):
        import_data([path], tmp_path / "rec", Said(poses={"file": "/none"}))
    with pytest.warns(PassedOver, match="poses of helmet"):
        assert len(imported(path, tmp_path / "rec", tof={}, poses={"file": "/vicon"})) == 3

    def still(bag):
        posed("PoseStamped")(bag)
        bag.tf(START, "tool0", "tof", (0, 0, 0.1))

    with pytest.warns(PassedOver, match="stand still on tool0"):
        imported(written(tmp_path / "box", change=still), tmp_path / "still", tof={})


def test_tf_of_many_nodes_that_stands_still(tmp_path):
    """Every node publishes it again on /tf_static, long before the frames."""

    def change(bag):
        bag.rows[:] = [r for r in bag.rows if r[0] != "/tf"]
        for k in range(3):
            bag.tf(START - (9 - k) * S, "base", "tof", (0.4, 0, 0))
        bag.rows[:] = [("/tf_static" if r[0] == "/tf" else r[0], *r[1:]) for r in bag.rows]

    found = imported(written(tmp_path / "mug", change=change), tmp_path / "rec", tof={})
    np.testing.assert_allclose([v.arm_before.T_base_flange[0, 3] for v in found], 0.4)


def without(*words):
    def change(bag):
        bag.rows[:] = [r for r in bag.rows if not any(w in r[0] for w in words)]

    return change


def every_second(topic):
    def change(bag):
        gone = [r for r in bag.rows if r[0] == topic][::2]
        bag.rows[:] = [r for r in bag.rows if all(r is not g for g in gone)]

    return change


def stamped(to):
    def change(bag):
        for i, (topic, _, time, message) in enumerate(bag.rows):
            if topic == "/tof/raw":
                message.header.stamp = bag.kind("builtin_interfaces/msg/Time")(**to(i, time))

    return change


def cloud_of_points(bag):
    bag.rows[:] = [r for r in bag.rows if r[0] != "/tof/depth"]
    bag.cloud("/stereo/points", START, np.ones((1, 500, 3)))


def jpeg(bag):
    bag.rows[:] = [r for r in bag.rows if r[0] != "/tof/raw"]
    data = cv2.imencode(".jpg", np.zeros((240, 40), np.uint8))[1].tobytes()
    bag.compressed("/tof/raw/compressed", START, data, "mono8; jpeg compressed mono8")


def zeros(bag):
    bag.rows[:] = [r for r in bag.rows if r[0] != "/tof/camera_info"]
    bag.camera("/tof/camera_info", START, fx=0.0)


def lost(bag):
    posed("PoseStamped")(bag)
    for topic, _, time, message in bag.rows:
        if topic == "/tracker" and time > START:
            message.pose.orientation.z = message.pose.orientation.w = 0.0


WRONG = {
    "empty": (lambda b: b.rows.clear(), {}, "no message at all", "info"),
    "no images": (without("raw", "depth"), {}, "/tf \\(TFMessage\\)", "info"),
    "no camera": (without("camera_info"), {}, "expected a CameraInfo beside /tof/raw", "--camera"),
    "zero camera": (zeros, {}, "CameraInfo of zeros", "--camera"),
    "zero stamps": (stamped(lambda i, t: {"sec": 0, "nanosec": 0}), {}, "its driver sets none", "received"),
    "milliseconds as seconds": (
        stamped(lambda i, t: {"sec": t // 1_000_000 % 2**31, "nanosec": 0}),
        {},
        "1e.03 times as fast",
        "received",
    ),
    "a clock that was set back": (
        stamped(lambda i, t: {"sec": (START // S if t == START else 1000) + i, "nanosec": 0}),
        {},
        "they go back by",
        "clock set",
    ),
    "a tracker that lost it": (lost, {}, "got NaN or a quaternion of length 0", "tracker"),
    "other clocks": (
        stamped(lambda i, t: {"sec": 5, "nanosec": t % S}),
        {},
        "from 5.000",
        "time_offset_s",
    ),
    "wrong topic": (None, {"raw": {"files": "/camera/raw"}}, "got topics /tof/raw", "/tof/raw"),
    "only depth": (without("/tof/raw"), {}, "expected raw images", "files"),
    "jpeg": (jpeg, {}, "JPEG loses", "republish"),
    "unorganised": (cloud_of_points, {}, "without rows and columns", "organised"),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_is_wrong_in_a_bag_is_named(tmp_path, name):
    """The message says what was found, the hint what to do; no scene appears."""
    change, said, message, hint = WRONG[name]
    path = written(tmp_path / "mug", "sqlite3", change=change)
    with pytest.raises(TofError, match=message) as info:
        import_data([path], tmp_path / "rec", Said(**said))
    assert hint in info.value.hint
    assert not list((tmp_path / "rec").glob("views/*"))


def test_half_of_the_channels_is_refused(tmp_path):
    path = written(tmp_path / "mug", "mcap", "topics", 6, every_second("/tof/phase_5/image_raw"))
    with pytest.raises(TofError, match="3 of 6 messages") as info:
        import_data([path], tmp_path / "rec", Said())
    assert "lost" in info.value.hint


def test_times_of_recording_replace_stamps_that_are_none(tmp_path):
    path = written(tmp_path / "mug", change=stamped(lambda i, t: {"sec": 0, "nanosec": 0}))
    found = imported(path, tmp_path / "rec", tof={}, raw={"stamps": "received"})
    assert [v.tof.time_ns[0] for v in found] == [START + i * S // 10 for i in range(3)]


@pytest.mark.parametrize("form", ["mcap", "sqlite3", "ros1"])
def test_a_damaged_bag_is_named(tmp_path, form):
    """Cut in half by a recorder that was killed."""
    path = written(tmp_path / "mug", form)
    file = path if path.is_file() else next(p for p in path.iterdir() if p.suffix in {".mcap", ".db3"})
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    with pytest.raises(TofError, match=r"cannot read the (bag|MCAP)") as info:
        import_data([path], tmp_path / "rec", Said())
    assert "reindex" in info.value.hint


def test_a_folder_of_bags_has_a_scene_each_and_knows_them_again(tmp_path):
    """The same bags are imported once; one that was recorded anew under its name is refused."""
    (tmp_path / "bags").mkdir()
    for name, form in (("mug", "mcap"), ("box", "ros1")):
        written(tmp_path / "bags" / name, form, views=2)
    import_data([tmp_path / "bags"], tmp_path / "rec", Said())
    assert {scene: len(views) for scene, views in find_views(tmp_path / "rec").items()} == {
        "box": 2,
        "mug": 2,
    }
    assert import_data([tmp_path / "bags"], tmp_path / "rec", Said()).skipped == ["box", "mug"]
    shutil.rmtree(tmp_path / "bags/mug")
    written(
        tmp_path / "bags/mug",
        "mcap",
        views=2,
        change=lambda b: b.rows.reverse() or b.tf(START, "a", "b", (0, 0, 1)),
    )
    with pytest.raises(TofError, match="is not of these data"):
        import_data([tmp_path / "bags"], tmp_path / "rec", Said())
