"""Order of a live stream: images continue it, restart it or are dropped."""

from __future__ import annotations

import pytest

from drocap_ros.reconstruction.live.frame_buffer import LATE_RUN, StreamEvent, StreamOrder

S = 10**9
Y1970, NOW, Y2100 = 0, 1_790_000_000 * S, 4_102_444_800 * S


def judge(
    *images: tuple[float, int], late_s: float = 1.0, gap_s: float = 1.0, confirm: bool = True
) -> list[StreamEvent]:
    order = StreamOrder(late_s=1.0, gap_s=1.0, confirm=confirm)
    return [order.classify(NOW + round(t * S), track) for t, track in images]


def test_regular_images_continue_the_stream() -> None:
    assert judge((0, 1), (0.1, 1), (0.2, 1)) == [StreamEvent.FIRST, StreamEvent.CONTINUED, StreamEvent.CONTINUED]


def test_duplicate_and_late_images_are_dropped_and_change_nothing() -> None:
    found = judge((0, 1), (0.3, 1), (0.3, 1), (0.3, 2), (0.1, 1), (-0.6, 1), (0.4, 1))
    assert found[2:] == [
        StreamEvent.DUPLICATE,
        StreamEvent.DUPLICATE,
        StreamEvent.LATE,
        StreamEvent.LATE,
        StreamEvent.CONTINUED,
    ]
    assert all(a.dropped for a in found[2:6])


def test_another_subject_restarts_and_a_gap_is_an_event() -> None:
    found = judge((0, 1), (0.1, 2), (1.1, 2), (2.2, 2), (3.4, 3))
    assert found == [
        StreamEvent.FIRST,
        StreamEvent.NEW_SUBJECT,
        StreamEvent.CONTINUED,
        StreamEvent.GAP,
        StreamEvent.NEW_SUBJECT,
    ]
    assert [a.restarted for a in found] == [True, True, False, False, True]


def test_another_image_size_restarts() -> None:
    order = StreamOrder(1.0, 1.0)
    found = [order.classify(NOW + i, 1, size) for i, size in enumerate([(1280, 720)] * 2 + [(640, 360)] * 2)]
    assert found == [StreamEvent.FIRST, StreamEvent.CONTINUED, StreamEvent.RESIZED, StreamEvent.CONTINUED]
    assert StreamEvent.RESIZED.restarted


@pytest.mark.parametrize("stray_ns", [Y1970, Y2100], ids=["1970", "2100"])
def test_a_single_stray_stamp_is_dropped(stray_ns: int) -> None:
    order = StreamOrder(1.0, 1.0)
    assert order.classify(NOW, 1) is StreamEvent.FIRST
    assert order.classify(stray_ns, 1) is StreamEvent.STRAY
    assert order.classify(NOW + S // 10, 1) is StreamEvent.CONTINUED
    # The next stray confirms no jump: the stream continued in between.
    assert order.classify(stray_ns + S // 10, 1) is StreamEvent.STRAY


@pytest.mark.parametrize("begin_ns", [Y1970, Y2100], ids=["1970", "2100"])
def test_a_stream_of_any_age_continues(begin_ns: int) -> None:
    order = StreamOrder(1.0, 1.0)
    found = [order.classify(begin_ns + i * S // 10, 1) for i in range(5)]
    assert found == [StreamEvent.FIRST, *[StreamEvent.CONTINUED] * 4]


@pytest.mark.parametrize("to_s", [-30.0, 500.0], ids=["back, as a looped bag", "ahead"])
def test_a_time_jump_restarts_with_its_second_image(to_s: float) -> None:
    found = judge((0, 1), (0.1, 1), (to_s, 1), (to_s + 0.1, 1), (to_s + 0.2, 1))
    assert found[2:] == [StreamEvent.STRAY, StreamEvent.TIME_JUMP, StreamEvent.CONTINUED]
    found = judge((0, 1), (0.1, 1), (to_s, 1), (to_s + 0.1, 1), confirm=False)
    assert found[2:] == [StreamEvent.TIME_JUMP, StreamEvent.CONTINUED]


def test_a_clock_set_back_restarts_after_a_run_of_late_images() -> None:
    back = [(9.3 + 0.03 * i, 1) for i in range(LATE_RUN + 2)]
    found = judge((10.0, 1), *back)
    assert found == [StreamEvent.FIRST, *[StreamEvent.LATE] * LATE_RUN, StreamEvent.TIME_JUMP, StreamEvent.CONTINUED]


def test_two_streams_on_one_topic_do_not_mix() -> None:
    order = StreamOrder(1.0, 1.0)
    kept = [
        clock
        for i in range(20)
        for clock, begin in (("a", NOW), ("b", NOW + 1000 * S))
        if not order.classify(begin + i * S // 30, 1).dropped
    ]
    assert set(kept) == {"a"}
    assert len(kept) == 20


def test_every_event_has_words() -> None:
    assert len({str(event) for event in StreamEvent}) == len(StreamEvent)
    assert all(str(event).startswith("dropped: ") == event.dropped for event in StreamEvent)
