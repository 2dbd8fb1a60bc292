"""A flight with each kind of mount is rebuilt in the world from its session alone."""

import dataclasses
from functools import lru_cache

import numpy as np
import pytest
from angles import angle_between
from recorded import NAMES, record

from drocap_ros.cli import main
from drocap_ros.config import DrocapConfig
from drocap_ros.errors import InputError
from drocap_ros.evaluation.compare import compare
from drocap_ros.flight.orbit.states import State
from drocap_ros.motion import load_motion
from drocap_ros.pipeline import Telemetry, reconstruct_input
from drocap_ros.recording.open_session import open_session
from drocap_ros.recording.session_tracks import read_pose2d
from drocap_ros.tracks import load_tracks
from lab.flights.orbit_loop import EPOCH_NS, LoopSettings, OrbitLoop, with_config

SECONDS = 18.0


class RecordedLoop(OrbitLoop):
    """Keeps what the bridge publishes, and the keypoints."""

    def __init__(self, settings, messages):
        super().__init__(settings)
        self.entries, self._messages = [], messages
        self.true_cameras = {}  # (3, 3) world -> optical by stamp, ns
        take_state, take_pose = self.controller.on_state, self.controller.on_pose2d

        def on_state(state):
            take_state(state)
            message = messages(
                NAMES["state"], header=messages.header(state.stamp_ns, "map"), mode=state.mode,
                position_enu_m=state.position_enu_m, velocity_enu_m_s=state.velocity_enu_m_s.astype(np.float32),
                orientation=messages.quaternion(state.orientation_xyzw),
                gimbal_orientation=messages.quaternion(state.gimbal_orientation_xyzw),
            )  # fmt: skip
            self._keep("/drocap/vehicle/state", message, state.stamp_ns)

        def on_pose2d(seen):
            take_pose(seen)
            width, height = seen.image_size
            message = messages(
                NAMES["pose2d"], header=messages.header(seen.stamp_ns), track_id=seen.track_id, skeleton="body15",
                image_width=width, image_height=height, roi=np.zeros(4, np.float32),
                keypoints=seen.keypoints.ravel(), covariance=seen.covariance.ravel(), confidence=seen.confidence,
            )  # fmt: skip
            self._keep("/drocap/pose2d", message, seen.stamp_ns)

        self.controller.on_state, self.controller.on_pose2d = on_state, on_pose2d
        info = messages(
            NAMES["info"], header=messages.header(EPOCH_NS), width=1280, height=720, k=self.matrix.ravel().copy()
        )
        self._keep("/drocap/camera_info", info, EPOCH_NS)

    def observe(self, joints, rotation, position):
        seen = super().observe(joints, rotation, position)
        self.true_cameras[seen.stamp_ns] = rotation
        return seen

    def _keep(self, topic, message, stamp_ns):
        self.entries.append((topic, message, stamp_ns, self._messages.cdr(message)))


def flown(mount, folder, messages):
    """Session and true joints of a flight; only the orbit is recorded."""
    settings = LoopSettings(
        mount=mount, action="boxing", seed=3, seconds=SECONDS, moves_from_s=5.0, wind_m_s=(3.0, 0.0, 0.0),
        field_deg=75.0,
    )  # fmt: skip
    loop = RecordedLoop(with_config(settings, radius_m=7.0, angular_speed_deg_s=14.0), messages)
    loop.start()
    loop.run(SECONDS - 0.5)
    assert loop.controller.safety.state == State.ORBITING, loop.reasons[-2:]
    from_ns = EPOCH_NS + int(5e9)
    record(folder, [e for e in loop.entries if e[2] >= from_ns or e[0].endswith("info")])
    return loop, np.arange(len(loop._joints)) / settings.perception_hz + EPOCH_NS * 1e-9


@pytest.fixture(scope="module")
def flight(tmp_path_factory, messages):
    """Gives the session, the loop and the time line of a flight with a mount; each is flown once."""

    @lru_cache
    def flight_with(mount):
        folder = tmp_path_factory.mktemp(mount) / "s"
        return folder, *flown(mount, folder, messages)

    return flight_with


@pytest.mark.parametrize("mount", ["gimbal", "servo", "fixed"])
def test_a_flight_is_rebuilt_in_the_world_from_its_session(mount, flight):
    folder, loop, time_s = flight(mount)
    config = DrocapConfig().replace("initializer", assumed_height_m=loop.settings.stature_m)
    motion, tracks = reconstruct_input(folder, method="ba", config=config)
    assert motion.frame == "world"
    true = np.array([loop.true_cameras[stamp] for stamp in tracks.stamp_ns.tolist()])
    camera_deg = np.rad2deg(angle_between(tracks.camera_rotation, true))
    errors = compare(motion, loop._joints, time_s, "world")
    print(
        f"{mount}: camera {np.median(camera_deg):.2f} deg, PA-MPJPE {errors.error_mm:.0f} mm, W-MPJPE(100)"
        f" {errors.world.w_mm:.0f} mm, horizon {errors.world.horizon_deg:.1f} deg"
    )
    assert np.median(camera_deg) < 1.0  # the autopilot's own error of the attitude
    assert errors.world.horizon_deg < 6.0
    assert errors.world.w_mm < 700.0  # the reported position wanders by 0.4 m: 435 mm with a gimbal


def test_a_session_of_a_fixed_camera_without_its_attitude_needs_the_pitch(tmp_path, flight, messages, capsys):
    folder, loop, _ = flight("fixed")
    pitch = loop.settings.camera_pitch_deg
    unknown = messages.quaternion(np.full(4, np.nan))
    old = []
    for topic, message, stamp_ns, cdr in loop.entries:
        if topic.endswith("state"):
            message = dataclasses.replace(message, gimbal_orientation=unknown)
            cdr = messages.cdr(message)
        old.append((topic, message, stamp_ns, cdr))
    record(tmp_path / "old", old)
    with open_session(folder) as session:
        recorded = read_pose2d(session)
        with pytest.raises(InputError, match="--mount-pitch"):
            read_pose2d(session, pitch)
    with open_session(tmp_path / "old") as session:
        assert read_pose2d(session).camera_rotation is None
    with open_session(tmp_path / "old") as session:
        given = read_pose2d(session, pitch)
    same = np.isin(given.stamp_ns, recorded.stamp_ns)
    assert np.abs(given.camera_rotation[same] - recorded.camera_rotation).max() < 1e-3
    options = ["--out", str(tmp_path / "out"), "--no-report", "--quiet", "--mount-pitch", f"{pitch:.3f}"]
    assert main(["reconstruct", str(folder), *options]) == 2
    assert "leave the option out" in capsys.readouterr().err
    assert main(["reconstruct", str(tmp_path / "old"), *options]) == 0
    assert load_motion(tmp_path / "out" / "motion.npz").frame == "world"
    assert main(["reconstruct", str(tmp_path / "old"), *options[:-1], "-120"]) == 2
    assert "--mount-pitch: expected -90 to 90 deg, got -120" in capsys.readouterr().err
    motion, _ = reconstruct_input(
        tmp_path / "old", method="initial", config=DrocapConfig(), telemetry=Telemetry(mount_pitch_deg=pitch)
    )
    assert motion.frame == "world"


def test_no_telemetry_is_that_of_a_session_and_of_its_tracks_neither(tmp_path, flight, capsys):
    folder, _, _ = flight("gimbal")
    options = ["--no-report", "--quiet", "--method", "initial"]
    assert main(["reconstruct", str(folder), *options, "--out", str(tmp_path / "world")]) == 0
    assert load_motion(tmp_path / "world").frame == "world"
    for source in (folder, tmp_path / "world" / "tracks.npz"):
        out = tmp_path / f"{source.name}_none"
        assert main(["reconstruct", str(source), *options, "--out", str(out), "--telemetry", "none"]) == 0
        assert load_motion(out).frame == "camera"
        assert load_tracks(out / "tracks.npz").camera_position is None
    command = ["reconstruct", str(folder), *options, "--telemetry", "none", "--mount-pitch", "-20"]
    assert main([*command, "--out", str(tmp_path / "x")]) == 2
    assert "--mount-pitch: expected --telemetry LOG with it" in capsys.readouterr().err
    assert (
        main(["reconstruct", str(folder), "--method", "live", "--telemetry", "none", "--out", str(tmp_path / "x")]) == 2
    )
    assert "--method live: expected the recorded telemetry" in capsys.readouterr().err
