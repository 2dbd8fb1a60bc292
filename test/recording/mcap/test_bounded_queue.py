import threading

from drocap_ros.recording.mcap.writer import BoundedQueue, QueuedMessage


def message(topic, size=10, number=0):
    return QueuedMessage(topic, bytes(size), number, number)


def test_messages_leave_in_order_of_arrival():
    queue = BoundedQueue(10_000)
    for i in range(50):
        assert queue.put(message("image" if i % 3 else "pose", 10, i), image=bool(i % 3))
    assert [queue.take(0).log_time_ns for _ in range(50)] == list(range(50))
    assert queue.take(0) is None
    assert queue.drop_count() == 0


def test_images_are_dropped_before_poses():
    queue = BoundedQueue(1000)
    images = sum(queue.put(message("image", 100), image=True) for _ in range(20))
    assert images == 8  # an eighth stays free
    poses = sum(queue.put(message("pose", 10), image=False) for _ in range(100))
    assert poses == 100
    assert queue.dropped == {"image": 20}  # 12 that did not fit, 8 replaced
    assert not queue.put(message("pose", 10), image=False)
    assert queue.dropped["pose"] == 1


def test_oldest_image_is_dropped_first():
    queue = BoundedQueue(800)
    for i in range(7):
        queue.put(message("image", 100, i), image=True)
    queue.put(message("pose", 250, 99), image=False)
    left = []
    while (taken := queue.take(0)) is not None:
        left.append(taken.log_time_ns)
    assert left == [2, 3, 4, 5, 6, 99]


def test_take_waits_for_a_message_and_returns_when_closed():
    queue, got = BoundedQueue(1000), []
    thread = threading.Thread(target=lambda: got.append(queue.take(10)))
    thread.start()
    queue.put(message("pose"), image=False)
    thread.join(5)
    assert got[0].topic == "pose"
    thread = threading.Thread(target=lambda: got.append(queue.take(10)))
    thread.start()
    queue.close()
    thread.join(5)
    assert got[1] is None
    assert not queue.put(message("pose"), image=False)


def test_each_dropped_message_is_counted_once():
    queue = BoundedQueue(800)
    put = [queue.put(message("image", 100, i), image=True) for i in range(9)]
    put += [queue.put(message("pose", 300, i), image=False) for i in range(4)]
    assert queue.put(message("late", 1, -1), image=False) is False
    taken = 0
    while queue.take(0) is not None:
        taken += 1
    assert taken + queue.drop_count() == len(put) + 1
    queue.put(message("pose", 10), image=False)
    queue.drop_all()
    queue.drop_all()
    assert taken + queue.drop_count() == len(put) + 2
