"""Which images continue a live stream, begin it anew, or are dropped."""

from __future__ import annotations

import pytest

from drocap_ros.reconstruction.live.stream_order import LATE_RUN, Arrival, StreamOrder

S = 10**9
Y1970, NOW, Y2100 = 0, 1_790_000_000 * S, 4_102_444_800 * S


def judge(*images: tuple[float, int], late_s: float = 1.0, gap_s: float = 1.0, confirm: bool = True) -> list[Arrival]:
    order = StreamOrder(late_s, gap_s, confirm=confirm)
    return [order.accept(NOW + round(t * S), track) for t, track in images]


def test_an_even_stream_continues() -> None:
    assert judge((0, 1), (0.1, 1), (0.2, 1)) == [Arrival.STARTED, Arrival.CONTINUED, Arrival.CONTINUED]


def test_duplicate_and_late_images_are_dropped_and_change_nothing() -> None:
    found = judge((0, 1), (0.3, 1), (0.3, 1), (0.3, 2), (0.1, 1), (-0.6, 1), (0.4, 1))
    assert found[2:] == [Arrival.DUPLICATE, Arrival.DUPLICATE, Arrival.LATE, Arrival.LATE, Arrival.CONTINUED]
    assert all(a.dropped for a in found[2:6])


def test_another_subject_starts_anew_and_a_gap_is_told() -> None:
    found = judge((0, 1), (0.1, 2), (1.1, 2), (2.2, 2), (3.4, 3))
    assert found == [Arrival.STARTED, Arrival.NEW_SUBJECT, Arrival.CONTINUED, Arrival.GAP, Arrival.NEW_SUBJECT]
    assert [a.anew for a in found] == [True, True, False, False, True]


@pytest.mark.parametrize("stray_ns", [Y1970, Y2100], ids=["1970", "2100"])
def test_one_stamp_from_another_age_is_dropped(stray_ns: int) -> None:
    order = StreamOrder(1.0, 1.0)
    assert order.accept(NOW, 1) is Arrival.STARTED
    assert order.accept(stray_ns, 1) is Arrival.STRAY
    assert order.accept(NOW + S // 10, 1) is Arrival.CONTINUED
    # The next stray confirms nothing: the stream went on in between.
    assert order.accept(stray_ns + S // 10, 1) is Arrival.STRAY


@pytest.mark.parametrize("begin_ns", [Y1970, Y2100], ids=["1970", "2100"])
def test_a_stream_that_lives_in_another_age_is_as_good_as_any(begin_ns: int) -> None:
    order = StreamOrder(1.0, 1.0)
    found = [order.accept(begin_ns + i * S // 10, 1) for i in range(5)]
    assert found == [Arrival.STARTED, *[Arrival.CONTINUED] * 4]


@pytest.mark.parametrize("to_s", [-30.0, 500.0], ids=["back, as a looped bag", "ahead"])
def test_time_that_jumps_starts_anew_with_the_second_image(to_s: float) -> None:
    found = judge((0, 1), (0.1, 1), (to_s, 1), (to_s + 0.1, 1), (to_s + 0.2, 1))
    assert found[2:] == [Arrival.STRAY, Arrival.RESTARTED, Arrival.CONTINUED]
    found = judge((0, 1), (0.1, 1), (to_s, 1), (to_s + 0.1, 1), confirm=False)
    assert found[2:] == [Arrival.RESTARTED, Arrival.CONTINUED]


def test_a_clock_set_back_a_little_is_believed_after_a_run_of_late_images() -> None:
    back = [(9.3 + 0.03 * i, 1) for i in range(LATE_RUN + 2)]
    found = judge((10.0, 1), *back)
    assert found == [Arrival.STARTED, *[Arrival.LATE] * LATE_RUN, Arrival.RESTARTED, Arrival.CONTINUED]


def test_two_streams_on_one_topic_do_not_mix() -> None:
    order = StreamOrder(1.0, 1.0)
    accepted = [
        clock
        for i in range(20)
        for clock, begin in (("a", NOW), ("b", NOW + 1000 * S))
        if not order.accept(begin + i * S // 30, 1).dropped
    ]
    assert set(accepted) == {"a"}
    assert len(accepted) == 20
