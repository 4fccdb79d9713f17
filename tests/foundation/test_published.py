"""Downloads of published files, from a server on the loopback address."""

import hashlib
import threading
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest

from jaxfit.foundation.errors import InputError
from jaxfit.foundation.published import PublishedFile, get_published

CONTENT = bytes(range(256)) * 2000
SHORT = 100_000


class Publisher(BaseHTTPRequestHandler):
    """Sends the content from the requested byte to the end.

    Under /short, it closes the connection in the middle, under /whole it always sends the whole content.
    """

    def do_GET(self):
        asked = self.headers.get("Range")
        start = 0 if asked is None or self.path == "/whole" else int(asked.removeprefix("bytes=").removesuffix("-"))
        found = 416 if start >= len(CONTENT) else 206 if start else 200
        self.send_response(found if self.path != "/missing" else 404)
        self.send_header("Content-Length", str(len(CONTENT) - start))
        self.end_headers()
        self.wfile.write(CONTENT[start : SHORT if self.path == "/short" else None])

    def log_message(self, *_):
        """Print nothing."""


@pytest.fixture(scope="module")
def address():
    server = ThreadingHTTPServer(("127.0.0.1", 0), Publisher)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}"
    server.shutdown()
    server.server_close()


def published(url, content=CONTENT):
    return PublishedFile("net.onnx", url, (hashlib.sha256(content).hexdigest(),), "jaxfit networks get it")


def test_a_download_and_its_progress(address, tmp_path):
    done = []

    @contextmanager
    def progress(name, total):
        yield lambda amount, note: done.append(amount)

    (path,) = get_published([published(f"{address}/net.onnx")], tmp_path / "new", progress=progress)
    assert path.read_bytes() == CONTENT
    assert sum(done) == len(CONTENT)
    again = get_published([published("http://127.0.0.1:1/closed")], tmp_path / "new")  # nothing is downloaded
    assert again == [path]


@pytest.mark.parametrize(
    ("place", "content", "words"),
    [
        ("/net.onnx", b"another", "SHA-256 differs"),
        ("/missing", CONTENT, "the server answers 404"),
    ],
)
def test_a_failed_download_leaves_nothing(address, tmp_path, place, content, words):
    with pytest.raises(InputError, match=rf"(?s){place}: .*{words}.*--from"):
        get_published([published(address + place, content)], tmp_path)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("place", ["/net.onnx", "/whole"])
def test_a_broken_download_continues(address, tmp_path, place):
    with pytest.raises(InputError, match=r"the connection broke off.*again, which continues, or give a folder"):
        get_published([published(f"{address}/short")], tmp_path)
    (part,) = tmp_path.iterdir()
    done = part.stat().st_size
    assert part.name == "net.onnx.part"
    assert 0 < done <= SHORT
    steps = []

    @contextmanager
    def progress(name, total):
        yield lambda amount, note: steps.append(amount)

    (path,) = get_published([published(address + place)], tmp_path, progress=progress)
    assert (path.read_bytes(), list(tmp_path.iterdir())) == (CONTENT, [path])
    assert steps[0] == (done if place == "/net.onnx" else 0)
    assert sum(steps) == len(CONTENT)


def test_a_part_of_another_file_is_not_kept(address, tmp_path):
    for length, words in ((2000, "SHA-256 differs"), (len(CONTENT), "the server answers 416")):
        (tmp_path / "net.onnx.part").write_bytes(b"x" * length)
        with pytest.raises(InputError, match=words):
            get_published([published(f"{address}/net.onnx")], tmp_path)
        assert not list(tmp_path.iterdir())


def test_no_network(tmp_path):
    with pytest.raises(InputError, match=r"cannot be downloaded: no connection .*check the network.*--from"):
        get_published([published("http://127.0.0.1:1/net.onnx")], tmp_path)


def test_copies_in_a_folder(tmp_path):
    source = tmp_path / "stick"
    source.mkdir()
    (source / "net.onnx").write_bytes(CONTENT)
    (path,) = get_published([published("http://127.0.0.1:1/")], tmp_path / "own", source)
    assert path.read_bytes() == CONTENT
    (source / "net.onnx").write_bytes(b"cut")
    with pytest.raises(InputError, match=r"stick/net.onnx: is not the published file"):
        get_published([published("http://127.0.0.1:1/")], tmp_path / "other", source)
    with pytest.raises(InputError, match=r"net.onnx: is not the published file.*remove the file and run"):
        get_published([published("http://127.0.0.1:1/", b"newer")], tmp_path / "own")
