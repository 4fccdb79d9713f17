"""A small film with its result, and a page of it with its server, for the tests of the viewer."""

import http.client
import json
import struct
import threading
from contextlib import contextmanager

import numpy as np
import uvicorn

from jaxfit.data.formats.coco import write_coco
from jaxfit.data.projection import projected_observations
from jaxfit.data.solution import save_solution
from jaxfit.export.result import open_result
from jaxfit.viewer.server import HOST, Viewer, listening, server_config
from jaxfit.viewer.session import Session
from jaxfit.viewer.shown import Shown
from support import overlays

TYPES = {"f4": np.float32, "i2": np.int16, "u1": np.uint8, "u2": np.uint16, "u4": np.uint32}


def write_result(folder, **changes):
    """Write a film and the folder of its result; returns the folder and the film."""
    video = overlays.film(folder / "film.mp4")
    solution = overlays.solution().with_arrays(**{"fps": overlays.FPS} | changes)
    result = folder / "result"
    save_solution(solution, overlays.BIRD, "base: fast\n", {"video": {"file": str(video)}}, result)
    write_coco(projected_observations(solution), result / "observations.json")
    return result, video


def shown(folder, **options):
    return Shown(folder, open_result(folder), **options)


def unpacked(content):
    """Decode packed arrays as `assets/data.js` does."""
    (size,) = struct.unpack("<I", content[:4])
    header = json.loads(content[4 : 4 + size])
    arrays = {}
    for name, entry in header["arrays"].items():
        start = 4 + size + entry["start"]
        assert start % 8 == 0  # typed arrays of browsers need it
        count = int(np.prod(entry["shape"]))
        arrays[name] = np.frombuffer(content, TYPES[entry["type"]], count, start).reshape(entry["shape"])
    return header["facts"], arrays


class Client:
    """Sends requests to a served page."""

    def __init__(self, port, token):
        self.port, self.token = port, token

    @property
    def address(self):
        return f"http://{HOST}:{self.port}/{self.token}/"

    def get(self, path, method="GET", body=None, **headers):
        """Send one request, whose path is used as it is; returns the status, the headers and the content."""
        connection = http.client.HTTPConnection(HOST, self.port, timeout=30)
        names = {name.replace("_", "-"): value for name, value in headers.items()}
        connection.putrequest(method, path, skip_host="Host" in names)
        for name, value in names.items():
            connection.putheader(name, value)
        if body is not None:
            connection.putheader("Content-Length", str(len(body)))
        connection.endheaders(body)
        answer = connection.getresponse()
        content = answer.read()
        connection.close()
        return answer.status, {name.lower(): value for name, value in answer.getheaders()}, content

    def of_page(self, path, **options):
        return self.get(f"/{self.token}/{path}", **options)


@contextmanager
def served(folder, video, edits=None, results=None, session=None):
    """Serve the page of a result in a thread; yields the client and the viewer."""
    session = session if edits is None else Session(folder, edits, None, video)
    viewer = Viewer(results or [shown(folder)], video, session, shown)
    sock = listening(None)
    port = sock.getsockname()[1]
    server = uvicorn.Server(server_config(viewer, port))
    thread = threading.Thread(target=server.run, kwargs={"sockets": [sock]})
    thread.start()
    try:
        yield Client(port, viewer.token), viewer
    finally:
        server.should_exit = True
        thread.join(30)
        sock.close()
