"""Node ``people_estimator``: the keypoints of persons beside the subject, each in a place of its own.

Subscribes ``image/compressed`` and ``pose2d``; publishes ``person_2/pose2d``, ``person_3/pose2d`` (drocap_ros/Pose2D)
with the image's header, ``track_id`` 0 while the place is free.  Its parameters are those of ``pose_estimator``.  In a
process of its own it leaves images out while the machine is busy, and changes nothing of the subject's keypoints.
"""

from __future__ import annotations

import itertools
from concurrent.futures import Future, ThreadPoolExecutor

from sensor_msgs.msg import CompressedImage

from drocap_ros.msg import Pose2D
from drocap_ros.observation import PoseObservation
from drocap_ros.perception.companions import Companions
from drocap_ros.perception.load_models import models_folder
from drocap_ros.perception.tracking.pose_estimator_config import PoseEstimatorConfig
from drocap_ros.reconstruction.live.frame_buffer import StampJoin
from drocap_ros.recording.image_messages import image_from_message
from drocap_ros.ros.component import OK, WARN
from drocap_ros.ros.conversions import pose2d_from_ros, pose2d_to_ros, stamp_from_ros
from drocap_ros.ros.diagnostics import Key
from drocap_ros.ros.lifecycle import ManagedComponent
from drocap_ros.ros.topics import IMAGE_IN_GRAPH_QOS, PLACES, publishers_of

#: Images that wait for the subject's keypoints: the subject's estimator holds as many and the one it works on.
_WAITING = 8
#: Ids of persons beside the subject, whose own count from 1.
_FIRST_ID = 1001
#: Ids of a node that was restarted begin at the second of its clock within eleven days: above all before it.
_RESTART_S = 10**6
#: Share of the last images that are left out from which the machine does not keep up, and how many these are.
_BEHIND, _RECENT = 0.2, 50


class PeopleEstimatorNode(ManagedComponent):
    """Follows others in the images whose subject is known, one image at a time."""

    component = "people_estimator"
    config: PoseEstimatorConfig
    needs = ("image/compressed", "pose2d")

    def build(self) -> None:
        """Declare endpoints and state."""
        self._companions: Companions | None = None
        first = _FIRST_ID + (self.now_ns() // 10**9 % _RESTART_S if self.restarted else 0)
        self._ids = itertools.count(first)
        self._join: StampJoin[CompressedImage, PoseObservation] = StampJoin(_WAITING)
        self._worker = ThreadPoolExecutor(1, "people_estimator")
        self._job: Future[None] | None = None
        self._shed = 0.0
        self._take = self.guarded("image/compressed", self._process, stamps=False)  # validated on arrival
        self._poses = {place: self.output(f"person_{place}/pose2d") for place in PLACES}
        qos = IMAGE_IN_GRAPH_QOS if publishers_of("image/compressed", self.peers) else None
        self.input("image/compressed", self._on_image, qos=qos)
        self.input("pose2d", self._on_pose2d)

    def acquire(self) -> None:
        """Load the networks."""
        self._companions = Companions(models_folder(self.config.models_dir), self.config, self._ids)

    def release(self) -> None:
        """Drop the networks and the persons."""
        self._finish()
        if self._companions is not None:
            self._companions.close()
        self._companions = None

    def flush(self) -> None:
        """End the image in progress."""
        self._finish()
        super().flush()

    def close(self) -> None:
        """End the thread."""
        super().close()
        self._worker.shutdown()

    def _finish(self) -> None:
        job, self._job = self._job, None
        if job is not None:
            job.result()

    def _on_image(self, message: CompressedImage) -> None:
        self._on_pair(self._join.add_first(stamp_from_ros(message.header.stamp), message))

    def _on_pose2d(self, message: Pose2D) -> None:
        observation = pose2d_from_ros(message)
        self._on_pair(self._join.add_second(observation.stamp_ns, observation))

    def _on_pair(self, pair: tuple[CompressedImage, PoseObservation] | None) -> None:
        if pair is None:
            return
        busy = self._job is not None and not self._job.done()
        self._shed += (busy - self._shed) / _RECENT
        if busy:
            self.count(Key.IMAGES_SHED)
            return
        self._finish()
        if self.simulated:
            self._take(*pair)
        else:
            self._job = self._worker.submit(self._take, *pair)

    def _process(self, message: CompressedImage, subject: PoseObservation) -> None:
        companions = self._companions
        assert companions is not None, "no message is taken before the node is active"
        places = companions.process(image_from_message(message, compressed=True), subject)
        for place, observation in places.items():
            self._poses[place].publish(pose2d_to_ros(observation, message.header.frame_id))
        self.count(Key.IMAGES)
        self.produced(subject.stamp_ns)
        followed = companions.followed
        self.details[Key.FOLLOWED] = ", ".join(map(str, followed))
        words = f"following {len(followed)} of at most {len(places)} beside the subject"
        if self._shed > _BEHIND:
            self.report(WARN, f"{words}, in {1 - self._shed:.0%} of the images: the machine does not keep up")
        else:
            self.report(OK, words)
