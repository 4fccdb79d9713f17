"""Downloads of published files, from a server on the loopback address."""

import hashlib
import threading
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest

from jaxfit.foundation.errors import InputError
from jaxfit.foundation.published import PublishedFile, get_published

CONTENT = bytes(range(256)) * 2000


class Publisher(BaseHTTPRequestHandler):
    """Sends the content; under /short, it closes the connection in the middle."""

    def do_GET(self):
        self.send_response(200 if self.path != "/missing" else 404)
        self.send_header("Content-Length", str(len(CONTENT)))
        self.end_headers()
        self.wfile.write(CONTENT[: 1000 if self.path == "/short" else None])

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
        ("/short", CONTENT, "the connection broke off"),
    ],
)
def test_a_failed_download_leaves_nothing(address, tmp_path, place, content, words):
    with pytest.raises(InputError, match=rf"(?s){place}: .*{words}.*--from"):
        get_published([published(address + place, content)], tmp_path)
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
