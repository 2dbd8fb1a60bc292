"""The download of models against a real HTTP server on the loopback interface."""

from __future__ import annotations

import hashlib
import http.server
import io
import threading
import zipfile
from dataclasses import replace
from typing import ClassVar

import pytest

from drocap_ros.errors import InputError
from drocap_ros.perception.models.fetch import DEFAULT_FETCH, KNOWN_MODELS, FetchError, KnownModel, fetch, known_model

WEIGHTS = bytes(range(256)) * 4000
SHA = hashlib.sha256(WEIGHTS).hexdigest()


class Handler(http.server.BaseHTTPRequestHandler):
    """Serves ``files``; understands Range; cuts the first answer off after ``cut`` bytes."""

    files: ClassVar[dict[str, bytes]] = {}
    cut: ClassVar[int | None] = None
    ranges: ClassVar[list[str | None]] = []

    def do_GET(self) -> None:
        self.ranges.append(self.headers.get("Range"))
        body = self.files.get(self.path)
        if body is None:
            self.send_error(404)
            return
        start = int(self.headers["Range"].removeprefix("bytes=").rstrip("-")) if self.headers.get("Range") else 0
        if start >= len(body):
            self.send_error(416)
            return
        self.send_response(206 if start else 200)
        self.send_header("Content-Length", str(len(body) - start))
        self.end_headers()
        rest = body[start:]
        if type(self).cut is not None:
            rest, type(self).cut = rest[: self.cut], None
            self.wfile.write(rest)
            self.connection.close()
            return
        self.wfile.write(rest)

    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture
def server():
    Handler.files, Handler.cut, Handler.ranges = {}, None, []
    httpd = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=httpd.serve_forever, daemon=True)
    thread.start()
    yield f"http://127.0.0.1:{httpd.server_port}"
    httpd.shutdown()
    httpd.server_close()


def model(url: str, **changes) -> KnownModel:
    plain = KnownModel("tiny", "pose", "tiny.onnx", 1.0, "Apache-2.0", "none", "here", url, "", SHA)
    return replace(plain, **changes)


def test_model_is_verified_and_not_fetched_twice(server, tmp_path):
    Handler.files["/tiny.onnx"] = WEIGHTS
    seen = []
    path = fetch(model(f"{server}/tiny.onnx"), tmp_path / "new", progress=lambda *a: seen.append(a))
    assert path.read_bytes() == WEIGHTS
    assert seen[-1] == (len(WEIGHTS), len(WEIGHTS))
    fetch(model(f"{server}/tiny.onnx"), tmp_path / "new")
    assert len(Handler.ranges) == 1
    assert [p.name for p in (tmp_path / "new").iterdir()] == ["tiny.onnx"]


def test_interrupted_download_resumes(server, tmp_path):
    Handler.files["/tiny.onnx"], Handler.cut = WEIGHTS, 300_000
    with pytest.raises(FetchError, match=r"300000 (of 1024000 )?bytes"):
        fetch(model(f"{server}/tiny.onnx"), tmp_path)
    assert not (tmp_path / "tiny.onnx").exists()
    assert fetch(model(f"{server}/tiny.onnx"), tmp_path).read_bytes() == WEIGHTS
    assert Handler.ranges == [None, "bytes=300000-"]


def test_wrong_checksum_leaves_no_file(server, tmp_path):
    Handler.files["/tiny.onnx"] = WEIGHTS[:-1] + b"x"
    with pytest.raises(FetchError, match=f"expected SHA-256 {SHA}"):
        fetch(model(f"{server}/tiny.onnx"), tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_model_is_extracted_from_an_archive(server, tmp_path):
    memory = io.BytesIO()
    with zipfile.ZipFile(memory, "w") as archive:
        archive.writestr("2023/model/end2end.onnx", WEIGHTS)
        archive.writestr("2023/model/detail.json", "{}")
    Handler.files["/tiny.zip"] = memory.getvalue()
    path = fetch(model(f"{server}/tiny.zip", member="end2end.onnx"), tmp_path)
    assert path.read_bytes() == WEIGHTS
    Handler.files["/tiny.zip"] = b"no archive"
    with pytest.raises(FetchError, match="expected a ZIP archive"):
        fetch(model(f"{server}/tiny.zip", member="end2end.onnx", file="b.onnx"), tmp_path)


def test_failed_downloads_are_reported_in_one_line(server, tmp_path):
    with pytest.raises(FetchError, match="answered 404"):
        fetch(model(f"{server}/nothing.onnx"), tmp_path)
    with pytest.raises(FetchError, match="check the network") as caught:
        fetch(model("http://127.0.0.1:9/tiny.onnx"), tmp_path)
    assert "\n" not in str(caught.value)
    with pytest.raises(InputError, match="does not; export it"):
        fetch(model("", name="tinypose"), tmp_path)


def test_registry_is_complete():
    assert len({m.name for m in KNOWN_MODELS}) == len({m.file for m in KNOWN_MODELS}) == len(KNOWN_MODELS)
    for name in DEFAULT_FETCH:
        found = known_model(name)
        assert found is not None
        assert found.sha256
        assert found.url.startswith("https://")
    for m in KNOWN_MODELS:
        assert m.licence
        assert m.training_data
        assert m.task in ("detector", "pose")
        assert len(m.sha256) == (64 if m.offered else 0)
    assert known_model("yolox_nano.onnx") is known_model("yolox-nano")
