"""Which mode counts, in whatever order its reports arrive."""

import random

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from drocap_ros.flight.mavlink.parser import CurrentMode, MavlinkParser
from drocap_ros.flight.mavlink.reports import MAX_LOSS, PacketOrder
from drocap_ros.flight.mavlink.state_estimator import VehicleStateEstimator

S = 1_000_000_000
MODES = {"OFFBOARD": 6 << 16, "LOITER": 4 << 16 | 3 << 24, "RTL": 4 << 16 | 5 << 24, "POSCTL": 3 << 16}
PX4 = mavlink.MAV_AUTOPILOT_PX4


def heartbeat(mode, armed=True):
    flags = mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED | (mavlink.MAV_MODE_FLAG_SAFETY_ARMED if armed else 0)
    return mavlink.MAVLink_heartbeat_message(2, PX4, flags, MODES[mode], 4, 3)


def current_mode(mode, intended=None):
    return CurrentMode(0, MODES[mode], MODES[intended or mode])


def packets(messages, first=250):
    """As the vehicle sends them: each with the next sequence number."""
    mav = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    decoded = []
    for i, message in enumerate(messages):
        mav.seq = (first + i) % 256
        decoded += MavlinkParser().feed(message.pack(mav))
    return decoded


def read(messages, period_s=0.02):
    estimator = VehicleStateEstimator()
    for i, message in enumerate(messages):
        estimator.update(message, round((1 + i * period_s) * S))
    return estimator.modes


def test_the_newer_report_counts_and_refreshes_the_age():
    beat, mode = packets([heartbeat("OFFBOARD"), current_mode("RTL", "RTL")])
    modes = read([beat, mode])
    assert (modes.mode, modes.intended, modes.armed) == ("RTL", "RTL", True)
    assert modes.age_s(2 * S) == pytest.approx(0.98)
    later = read(packets([heartbeat("OFFBOARD"), current_mode("OFFBOARD"), heartbeat("LOITER", armed=False)]))
    assert (later.mode, later.intended, later.armed) == ("LOITER", "", False)


def test_a_failsafe_keeps_the_intention_and_the_pilot_changes_it():
    modes = read(packets([heartbeat("OFFBOARD"), current_mode("LOITER", "OFFBOARD"), heartbeat("LOITER")]))
    assert (modes.mode, modes.intended) == ("LOITER", "OFFBOARD")


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.9])
def test_the_share_of_lost_packets_is_measured_by_their_sequence_numbers(share):
    chance, order, found = random.Random(7), PacketOrder(), []
    for sequence in range(3000):
        if chance.random() >= share:
            assert not order.is_late(sequence % 256)
            found.append(order.loss)
    settled = found[len(found) // 10 :]
    assert sum(settled) / len(settled) == pytest.approx(share, abs=0.06)
    assert (max(settled) < MAX_LOSS) if share < 0.3 else (min(settled) > MAX_LOSS)


def test_packets_in_another_order_are_not_lost():
    chance, order = random.Random(7), PacketOrder()
    arrivals = sorted(range(3000), key=lambda sequence: sequence + chance.uniform(0, 8))
    late = [order.is_late(sequence % 256) for sequence in arrivals]
    assert any(late)
    assert order.loss < 0.1


def test_a_lossy_link_is_noticed_within_half_a_second_of_telemetry_and_forgotten_within_a_second():
    chance, order, sequence = random.Random(7), PacketOrder(), 0
    while order.loss <= MAX_LOSS:
        sequence += 1
        if chance.random() >= 0.5:
            order.is_late(sequence % 256)
    assert sequence < 90
    for after in range(1, 90):
        order.is_late((sequence + after) % 256)
    assert order.loss < MAX_LOSS


def test_a_mode_is_not_fresh_where_many_packets_are_lost():
    beats = packets([heartbeat("OFFBOARD")] * 60)
    for lost, mode in ((1, "OFFBOARD"), (3, "")):
        estimator = VehicleStateEstimator()
        for i, beat in enumerate(beats[::lost]):
            estimator.update(beat, round((1 + 0.02 * i) * S))
        assert estimator.fresh_mode(round((1 + 0.02 * i) * S), 0.1, 1e12) == mode


def test_before_the_first_heartbeat_a_number_has_no_name():
    assert read(packets([current_mode("OFFBOARD")])).mode == ""


@given(
    st.lists(st.tuples(st.booleans(), st.sampled_from(sorted(MODES))), min_size=1, max_size=24),
    st.randoms(use_true_random=False),
    st.integers(0, 255),
)
def test_in_any_order_the_last_mode_counts_and_no_other_is_overlooked(reports, chance, first):
    messages = [heartbeat("LOITER")] + [heartbeat(mode) if beat else current_mode(mode) for beat, mode in reports]
    sent = packets(messages, first)
    shuffled = sent[1:]
    chance.shuffle(shuffled)
    estimator = VehicleStateEstimator()
    estimator.update(sent[0], S)
    heard = set(estimator.modes.take_heard())
    for i, message in enumerate(shuffled):
        estimator.update(message, S + i)
        heard |= estimator.modes.take_heard()
    assert estimator.modes.mode == reports[-1][1]
    assert heard == {"LOITER", *(mode for _, mode in reports)}


def test_after_a_gap_the_sequence_begins_again():
    estimator = VehicleStateEstimator()
    old = packets([heartbeat("OFFBOARD")], first=100)[0]
    restarted = packets([heartbeat("LOITER")], first=0)[0]
    estimator.update(old, S)
    estimator.update(restarted, 2 * S)
    assert estimator.modes.mode == "LOITER"


def test_a_late_report_of_the_mode_before_is_no_news():
    before, change, after = packets([heartbeat("LOITER"), heartbeat("LOITER"), current_mode("OFFBOARD")])
    modes = read([before, after])
    modes.take_heard()
    estimator = VehicleStateEstimator()
    for message in (before, after):
        estimator.update(message, S)
    estimator.modes.take_heard()
    estimator.update(change, S + 1)
    assert (estimator.modes.mode, estimator.modes.take_heard()) == ("OFFBOARD", frozenset())


def test_a_late_report_of_a_mode_in_between_is_heard():
    estimator = VehicleStateEstimator()
    first, between, last = packets([heartbeat("OFFBOARD"), current_mode("RTL"), current_mode("OFFBOARD")])
    for message in (first, last):
        estimator.update(message, S)
    estimator.modes.take_heard()
    age_s = estimator.modes.age_s(2 * S)
    estimator.update(between, S + 10)
    assert (estimator.modes.mode, estimator.modes.take_heard()) == ("OFFBOARD", {"RTL"})
    assert estimator.modes.age_s(2 * S) == age_s
