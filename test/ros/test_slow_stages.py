"""Stages that are too slow for what comes: nothing waits in line, and what is passed over is counted."""

from __future__ import annotations

import time
from collections import deque
from types import SimpleNamespace

import numpy as np
import pytest
import rclpy
from live_stream import observed
from rclpy.context import Context
from sensor_msgs.msg import CompressedImage

from drocap_ros.bringup import bringup, free_domain
from drocap_ros.config import DrocapConfig
from drocap_ros.nodes.bundle_adjuster import BundleAdjusterNode
from drocap_ros.nodes.image_ingest import ImageIngestNode
from drocap_ros.nodes.pose_estimator import ImageQueue
from drocap_ros.perception.sources.base import ImageIngestConfig
from drocap_ros.reconstruction.live.core import LiveCore
from drocap_ros.reconstruction.live.initializer import LiveInitializer
from drocap_ros.ros import component
from drocap_ros.ros.component import Line
from drocap_ros.ros.conversions import header_at, pose2d_to_ros, stamp_from_ros
from drocap_ros.ros.diagnostics import Key
from drocap_ros.ros.topics import TOPICS

PERIOD_S, WORK_S = 1 / 30, 0.02
SKIP_S = 0.0005  # cost of a message that is passed over


def images_of(work_s, images=300, seldom=1):
    """Age (s) of each image when its work is done, and how many were passed over, of a stage behind an image queue.

    seldom : only every so many images cost more than a tenth of that
    """
    due, clock = deque(PERIOD_S * i for i in range(images)), [0.0]  # what the queue's clock shows, one by one
    queue = ImageQueue(4, lambda: round((clock.pop(0) if len(clock) > 1 else clock[0]) * 1e9))
    ages, missed, waiting, end_s = [], 0, 0, 0.0
    while due or waiting:
        begin_s = end_s if waiting else max(end_s, due[0])
        while due and due[0] <= begin_s:
            clock[:] = [due.popleft()]
            queue.put(CompressedImage(header=header_at(round(clock[0] * 1e9), "c")))
            waiting = min(waiting + 1, 4)
        clock[:] = [end_s, begin_s] if ages else [begin_s]
        sample = queue.take()
        waiting, missed = sample.behind, missed + sample.missed
        end_s = begin_s + (0.1 * work_s if len(ages) % seldom else work_s)
        ages.append(end_s - stamp_from_ros(sample.message.header.stamp) * 1e-9)
    return np.array(ages), missed


def messages_of(work_s, messages=300):
    """The same of a stage that subscribes to the newest messages, whose line is that of the middleware."""
    line, now_s, ages, missed = Line(), 0.0, [], 0
    for i in range(messages):
        arrived_s = 1.0 + PERIOD_S * i
        now_s = max(now_s, arrived_s)
        if line.passes_over({"received_timestamp": round(arrived_s * 1e9)}, round(now_s * 1e9)):
            now_s, missed = now_s + SKIP_S, missed + 1
            continue
        now_s += work_s
        line.took(work_s)
        ages.append(now_s - arrived_s)
    return np.array(ages), missed


@pytest.mark.parametrize("stage", [images_of, messages_of])
@pytest.mark.parametrize("slower", [1, 2, 4, 8, 32])
def test_no_result_is_older_than_two_periods_of_its_stage_and_its_work(stage, slower):
    work_s = slower * WORK_S
    ages, missed = stage(work_s)
    period_s = max(work_s, PERIOD_S)
    assert ages.max() <= 2 * period_s + work_s + 1e-9
    assert len(ages) + missed == 300
    # As many results as there is time for, and all of them where there is enough.
    assert len(ages) >= 0.7 * 300 * PERIOD_S / period_s
    assert missed == 0 or work_s > PERIOD_S


@pytest.mark.parametrize("slower", [1, 2, 4, 8])
def test_an_image_topic_that_is_too_fast_is_passed_over_up_to_its_newest_images(slower, monkeypatch):
    """Of the middleware's queue, which keeps the newest; the clock is that of the test."""
    now_s, ages, work_s = [1.0], [], slower * WORK_S

    def take(self, message):
        now_s[0] += work_s
        ages.append(now_s[0] - message.arrived_s)

    monkeypatch.setattr(ImageIngestNode, "_take", take)
    monkeypatch.setattr(component.time, "time_ns", lambda: round(now_s[0] * 1e9))
    with free_domain() as domain_id:
        context = Context()
        rclpy.init(args=[], context=context, domain_id=domain_id)
        node = ImageIngestNode(ImageIngestConfig(source="topic:/camera"), context=context, use_global_arguments=False)
        try:
            node.active, heard = True, node.newest("/camera", node._take, stamps=False)
            waiting, due = deque(maxlen=5), deque(1.0 + PERIOD_S * i for i in range(300))
            while due or waiting:
                now_s[0] = now_s[0] if waiting else max(now_s[0], due[0])
                while due and due[0] <= now_s[0]:
                    waiting.append(due.popleft())
                arrived_s = waiting.popleft()
                heard(SimpleNamespace(arrived_s=arrived_s), {"received_timestamp": round(arrived_s * 1e9)})
        finally:
            node.close()
            node.destroy_node()
            context.try_shutdown()
    assert max(ages) <= 2 * max(work_s, PERIOD_S) + work_s + 1e-6
    assert len(ages) >= 0.7 * 300 * PERIOD_S / max(work_s, PERIOD_S)


def test_images_that_wait_behind_a_seldom_long_one_all_count():
    ages, missed = images_of(0.08, seldom=4)
    assert missed == 0
    assert ages.max() < 0.15


@pytest.mark.parametrize(("pause_s", "most"), [(0.5, 0), (2.5, 75)])
def test_a_short_pause_of_the_machine_costs_no_image_and_a_long_one_those_of_the_pause(pause_s, most):
    line, taken, now_s = Line(), [], 0.0
    for i in range(140):
        arrived_s = 1.0 + PERIOD_S * i
        now_s = max(arrived_s, now_s)
        now_s = max(now_s, 1.4 + pause_s) if now_s > 1.4 else now_s  # nothing runs meanwhile
        taken.append(not line.passes_over({"received_timestamp": round(arrived_s * 1e9)}, round(now_s * 1e9)))
        now_s += 0.007 if taken[-1] else SKIP_S
        line.took(0.007)
    assert 0.9 * most <= taken.count(False) <= most
    assert all(taken[:12])
    assert all(taken[-12:])


STAGES = {"initializer": (LiveInitializer, "push"), "latest": (LiveCore, "_latest")}


@pytest.mark.parametrize("stage", [*STAGES, "adjustment"])
def test_a_slow_stage_of_the_graph_delays_its_results_by_its_own_work_alone(stage, monkeypatch):
    """Each by 0.3 s, with images at 24 Hz: a line would be 5 s long at the end."""
    work_s, seen = 0.3, {"pose3d/initial": [], "pose3d/latest": [], "/diagnostics": []}
    if stage in STAGES:
        owner, name = STAGES[stage]
        own = getattr(owner, name)
        monkeypatch.setattr(owner, name, lambda *args: (time.sleep(work_s), own(*args))[1])
    else:
        solve = BundleAdjusterNode._solve
        monkeypatch.setattr(BundleAdjusterNode, "_solve", lambda *args: (time.sleep(8 * work_s), solve(*args))[1])
    with bringup(DrocapConfig(), ["initializer", "bundle_adjuster"]) as graph:
        for topic, heard in seen.items():
            take = (lambda m, heard=heard: heard.append((time.time(), m))) if topic != "/diagnostics" else heard.append
            graph.node.create_subscription(TOPICS[topic].message, topic, take, TOPICS[topic].qos)
        publisher = graph.node.create_publisher(TOPICS["pose2d"].message, "pose2d", TOPICS["pose2d"].qos)
        graph.wait_until(lambda: publisher.get_subscription_count() == 2, 20, "the nodes to listen")
        begin_ns = time.time_ns()
        for observation in observed(144, begin_ns):
            graph.spin_for(max(0.0, observation.stamp_ns * 1e-9 - time.time()))
            publisher.publish(pose2d_to_ros(observation, "camera"))
        graph.spin_for(3 * work_s + 1.0)
    late = {
        topic: [at_s - stamp_from_ros(m.header.stamp) * 1e-9 for at_s, m in seen[topic]]
        for topic in ("pose3d/initial", "pose3d/latest")
    }
    for topic, ages in late.items():
        slow = stage in STAGES and (stage == "initializer" or topic == "pose3d/latest")
        # Half a second more for a busy machine.
        assert np.quantile(ages, 0.9) < (3 * work_s if slow else 0.0) + 0.5
        assert len(ages) > (10 if slow else 100)
    values = {
        s.name.rsplit("/", 1)[-1]: {v.key: v.value for v in s.values} for m in seen["/diagnostics"] for s in m.status
    }
    if stage in STAGES:
        node = {"initializer": "initializer", "latest": "bundle_adjuster"}[stage]
        assert sum(int(v) for k, v in values[node].items() if k.startswith(Key.MISSED)) > 60
        assert any("this machine passes over" in s.message for m in seen["/diagnostics"] for s in m.status)
