from __future__ import annotations

import io
import zipfile

import pytest

from drocap_ros.file_kind import FileKind, file_kind


def packets(size: int, sync: int) -> bytes:
    return (b"\x01" * sync + b"\x47" + b"\x02" * (size - sync - 1)) * 6


def archive() -> bytes:
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w") as file:
        file.writestr("keypoints.npy", b"\x93NUMPY")
    return data.getvalue()


@pytest.mark.parametrize(
    ("head", "kind"),
    [
        (b"\0\0\0\x20ftypisom\0\0\x02\0", FileKind.VIDEO),
        (b"\0\0\0\x08wide\0\0\0\0mdat", FileKind.VIDEO),
        (b"\x1a\x45\xdf\xa3\x9fB\x86\x81", FileKind.VIDEO),
        (b"RIFF\x10\0\0\0AVI LIST", FileKind.VIDEO),
        (packets(188, 0), FileKind.VIDEO),
        (packets(188, 90), FileKind.VIDEO),  # recorded from the middle of a packet on
        (packets(192, 4), FileKind.VIDEO),
        (b"\0\0\0\x01\x67\x64\0\x16", FileKind.VIDEO),
        (b"\0\0\x01\x40\x01\x0c", FileKind.VIDEO),
        (b"\0\0\x01\xba\x44", FileKind.VIDEO),
        (b"\xff\xd8\xff\xe1..Exif", FileKind.IMAGE),
        (b"II*\0\x08\0\0\0", FileKind.IMAGE),
        (b"RIFF\x10\0\0\0WEBPVP8 ", FileKind.IMAGE),
        (b"\0\0\0\x1cftypheic\0\0\0\0", FileKind.IMAGE),
        (b"\x89MCAP0\r\n", FileKind.MCAP),
        (b"#ROSBAG V2.0\n", FileKind.ROSBAG1),
        (b"SQLite format 3\0\x10", FileKind.SQLITE),
        (archive(), FileKind.ARRAYS),
        (b"", FileKind.EMPTY),
        (b"\x1b[31m###\r\n" * 40, FileKind.TEXT),
        (b"#EXTM3U\n#EXTINF:10,\nhttp://127.0.0.1/a.ts\n", FileKind.TEXT),
        (b"ffconcat version 1.0\nfile '/etc/passwd'\n", FileKind.TEXT),
        ("1\n00:00:00,000 --> 00:00:01,000\nhöhe 5 m\n".encode(), FileKind.TEXT),
        (b"ID3\x04\0\0\0\0\0\0", FileKind.OTHER),
        (bytes(range(1, 32)) * 9, FileKind.OTHER),
    ],
)
def test_first_bytes_decide(tmp_path, head, kind):
    (tmp_path / "any.name").write_bytes(head)
    assert file_kind(tmp_path / "any.name") is kind
