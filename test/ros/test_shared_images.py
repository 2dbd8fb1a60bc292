"""Decoded images in shared memory: whole ones of their stamps, or none."""

from __future__ import annotations

import os
import threading
from types import SimpleNamespace

import numpy as np
import pytest

from drocap_ros.ros import shared_images
from drocap_ros.ros.shared_images import SharedImages


@pytest.fixture
def ring(tmp_path, monkeypatch):
    """A writer and a reader of one graph."""
    monkeypatch.setattr(shared_images, "_FOLDER", tmp_path)
    node = SimpleNamespace(context=SimpleNamespace(get_domain_id=lambda: 7), get_namespace=lambda: "/a/b")
    pair = SharedImages(node), SharedImages(node)
    yield pair
    for end in pair:
        end.close()
    assert not list(tmp_path.iterdir())


def image_of(number, size=(36, 64)):
    return np.full((*size, 3), number % 251, np.uint8)


def test_the_newest_images_are_found_by_their_stamps(ring):
    writer, reader = ring
    assert reader.get(1) is None
    for number in range(1, 20):
        writer.put(number, image_of(number))
        assert np.array_equal(reader.get(number), image_of(number))
    assert [reader.get(number) is None for number in (11, 12, 20)] == [True, False, True]
    # Another size, and another writer after the death of the first one.
    writer.put(30, image_of(30, (20, 10)))
    assert np.array_equal(reader.get(30), image_of(30, (20, 10)))
    reader.close()  # as one that starts anew: its writer goes on in a new file
    writer.put(31, image_of(31, (20, 10)))
    assert np.array_equal(reader.get(31), image_of(31, (20, 10)))
    writer.close()
    assert reader.get(31) is None


def test_no_image_is_a_mixture_of_two(ring):
    """A reader looks for any stamp that is there now, while the writer goes on."""
    writer, reader = ring
    ended, found = threading.Event(), 0

    def write():
        number = 0
        while not ended.is_set():
            number += 1
            writer.put(number, image_of(number, (90, 160)))

    thread = threading.Thread(target=write, daemon=True)
    thread.start()
    while found < 20:
        reader.get(1)  # opens the memory
        stamps = [] if reader._memory is None else reader._head()[3:].tolist()
        for stamp in stamps:
            if stamp and (image := reader.get(stamp)) is not None:
                assert (image == stamp % 251).all()
                found += 1
    ended.set()
    thread.join()


def test_where_there_is_no_room_or_another_ones_file_there_are_no_images(ring, monkeypatch):
    writer, reader = ring
    monkeypatch.setattr(os, "statvfs", lambda _: SimpleNamespace(f_bavail=1, f_frsize=4096))
    writer.put(1, image_of(1))
    assert reader.get(1) is None
    monkeypatch.undo()
