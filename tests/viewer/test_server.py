"""The server answers its own page only: token, host, origin, paths; it serves the film by ranges and takes edits."""

import json
import os
import socket
import stat
import time
from pathlib import Path
from urllib.parse import urlsplit
from urllib.request import url2pathname

import pytest
from support import films
from support.cli_files import rejected
from support.viewed import served, unpacked, write_result

from jaxfit.cli import view
from jaxfit.cli.main import main
from jaxfit.data.formats.coco import read_coco
from jaxfit.foundation.errors import InputError
from jaxfit.review.edits import read_edits
from jaxfit.viewer import server, session
from jaxfit.viewer.server import HOST, LARGEST_BODY, listening
from jaxfit.viewer.session import Session


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    folder = tmp_path_factory.mktemp("served")
    result, video = write_result(folder)
    with served(result, video, folder / "result.edits") as (client, viewer):
        yield client, viewer, video


def test_the_page_loads_only_its_own_files(page):
    client, _, _ = page
    status, headers, content = client.of_page("")
    assert status == 200
    text = content.decode()
    assert "http://" not in text
    assert "https://" not in text
    policy = headers["content-security-policy"]
    assert "default-src 'none'" in policy
    assert "connect-src 'self'" in policy
    assert "unsafe-eval" not in policy
    assert headers["cache-control"] == "no-store"
    assert headers["x-content-type-options"] == "nosniff"
    assert headers["cross-origin-resource-policy"] == "same-origin"
    for name, kind in (
        ("main.js", "text/javascript"),
        ("style.css", "text/css"),
        ("three.core.min.js", "text/javascript"),
    ):
        status, headers, content = client.of_page(f"page/{name}")
        assert (status, headers["content-type"].split(";")[0]) == (200, kind)
        assert content


@pytest.mark.parametrize(
    "path", ["/", "/facts", "/x/", "/{token}", "/{token}x/facts", "/x{token}/facts", "//{token}/facts"]
)
def test_without_the_token_nothing_is_answered(page, path):
    client, _, _ = page
    status, _, content = client.get(path.format(token=client.token))
    assert status == 403
    assert client.token.encode() not in content


@pytest.mark.parametrize(
    "headers",
    [
        {"Host": "evil.example"},
        {"Host": "evil.example:{port}"},
        {"Host": "127.0.0.1:1"},
        {"Origin": "http://evil.example"},
        {"Origin": "null"},
        {"Sec_Fetch_Site": "cross-site"},
        {"Sec_Fetch_Site": "same-site"},
    ],
)
def test_requests_of_other_pages_are_refused(page, headers):
    client, _, _ = page
    headers = {name: value.format(port=client.port) for name, value in headers.items()}
    assert client.of_page("facts", **headers)[0] == 403
    body = json.dumps({"edits": ["delete 4"]}).encode()
    assert client.of_page("change/edits", method="POST", body=body, **headers)[0] == 403


def test_the_page_itself_is_answered(page):
    client, _, _ = page
    for host in ("127.0.0.1", "localhost"):
        headers = {"Host": f"{host}:{client.port}", "Origin": f"http://{host}:{client.port}"}
        assert client.of_page("facts", **headers, Sec_Fetch_Site="same-origin")[0] == 200


@pytest.mark.parametrize(
    "path",
    [
        "page/../server.py",
        "page/%2e%2e/server.py",
        "page/..%2fserver.py",
        "page/..%5cserver.py",
        "page//etc/passwd",
        "page/%2fetc%2fpasswd",
        "page/index.html",
        "film/../../etc/passwd",
        "results/0/poses/../../../etc/passwd",
        "results/7/rig",
        "results/-1/rig",
        "results/0/poses/999999999999",
        "results/0/poses/x",
        "results/0/poses/" + "9" * 5000,
        "results/" + "9" * 5000 + "/rig",
        "frames/" + "9" * 5000,
        "frames/-1",
        "results/0/poses",
        "results/0/rig/1",
        "results/0/values/no_such_value",
        "results/0/values/os:system",
        "change/edits",
    ],
)
def test_paths_and_names_that_are_not_of_the_page(page, path):
    client, _, _ = page
    status, _, content = client.of_page(path)
    assert status in (403, 404, 405)
    assert b"import" not in content
    assert b"root:" not in content


def test_a_part_that_is_not_there_is_one_sentence(page):
    client, _, _ = page
    status, _, content = client.of_page("results/0/poses/99")
    assert status == 400
    assert "part 99" in json.loads(content)["problem"]


def test_the_film_is_served_by_ranges(page):
    client, _, video = page
    content = video.read_bytes()
    assert client.of_page("film")[2] == content
    status, headers, part = client.of_page("film", Range="bytes=10-29")
    assert (status, part) == (206, content[10:30])
    assert headers["content-range"] == f"bytes 10-29/{len(content)}"
    status, headers, picture = client.of_page("frames/4")
    assert (status, headers["content-type"], picture[:2]) == (200, "image/jpeg", b"\xff\xd8")
    status, _, answer = client.of_page("frames/4000")
    assert status == 400
    assert "frame 4000" in json.loads(answer)["problem"]


def test_arrays_of_the_result(page):
    client, viewer, _ = page
    for path, expected in (("rig", viewer.results[0].rig()), ("poses/0", viewer.results[0].part(0))):
        assert client.of_page(f"results/0/{path}")[2] == expected
    _, arrays = unpacked(client.of_page("results/0/flags")[2])
    assert arrays["flags"].shape == (2, 6)


def test_edits_are_stored_and_wrong_ones_refused(page):
    client, viewer, _ = page
    path = viewer.session.edits_path

    def send(content, action="edits"):
        status, _, answer = client.of_page(f"change/{action}", method="POST", body=content)
        return status, json.loads(answer) if answer[:1] == b"{" else answer

    path.write_text("# two birds cross\n")
    assert send(b'{"edits": ["swap 4,11@5", "exclude 4@3:5"], "known": []}')[0] == 200
    stored = path.read_text()
    assert stored == "# two birds cross\nswap 4,11@5\nexclude 4@3:5\n"
    assert [str(edit) for edit in Session(viewer.session.folder, path, None, None).edits] == [
        "swap 4,11@5",
        "exclude 4@3:5",
    ]
    for wrong in (b'{"edits": ["explode 4"]}', b'{"edits": [4]}', b'{"edits": "swap 4,11"}', b"[]", b"{", b"\xff"):
        status, answer = send(wrong)
        assert status == 400
        assert answer["problem"]
    assert send(b"{}", "no_such_action")[0] == 404
    assert send(b'{"frames": []}', "mark")[0] == 400
    assert send(b" " * (LARGEST_BODY + 1))[0] == 413
    assert path.read_text() == stored
    known, many = json.dumps(["swap 4,11@5", "exclude 4@3:5"]).encode(), ["swap 4,11@5"] * 20_000
    assert send(b'{"edits": %s, "known": %s}' % (json.dumps(many).encode(), known))[0] == 200
    assert len(Session(viewer.session.folder, path, None, None).edits) == len(many)
    assert send(b'{"edits": [], "known": %s}' % json.dumps(many).encode())[0] == 200


@pytest.mark.parametrize("by", ["another viewer", "another page", "hand", "deletion"])
def test_edits_of_others_are_not_erased(page, by):
    """The answer 409 has the list of the file, from which the page goes on; comments stay."""
    client, viewer, video = page
    path = viewer.session.edits_path
    path.write_text("# mine\n\ndelete 4 \n")

    def send(edits, known, action="edits"):
        body = json.dumps({"edits": edits, "known": known}).encode()
        status, _, answer = client.of_page(f"change/{action}", method="POST", body=body)
        return status, json.loads(answer)

    assert send(["delete 4", "cut 11@5"], ["delete 4"])[0] == 200
    text = "# mine\n\ndelete 4 \ncut 11@5\n"
    assert path.read_text() == text
    if by == "another viewer":
        Session(viewer.session.folder, path, None, video).set_edits(["delete 4", "join 4,11"], ["delete 4", "cut 11@5"])
        text = "# mine\n\ndelete 4 \njoin 4,11\n"
    elif by == "another page":
        assert send(["delete 4"], ["delete 4", "cut 11@5"])[0] == 200
        text = "# mine\n\ndelete 4 \n"
    elif by == "hand":
        text = "delete 11\n# see frame 7\n"
        path.write_text(text)
    else:
        path.unlink()
    for action in ("edits", "refit"):
        status, answer = send([], ["delete 4", "cut 11@5"], action)
        assert status == 409
        assert "result.edits: were changed" in answer["problem"]
        assert answer["edits"] == list(map(str, read_edits(path) if path.exists() else []))
        assert (path.read_text() if path.exists() else text) == text
    assert send([], answer["edits"])[0] == 200
    assert path.read_text() == "".join(f"{line}\n" for line in text.splitlines() if line[:1] in "#") * (
        by != "deletion"
    )


def test_a_film_that_is_removed_or_replaced_is_one_sentence(tmp_path, caplog):
    folder, video = write_result(tmp_path)
    with served(folder, video) as (client, _):
        assert client.of_page("film", Range="bytes=0-9")[0] == 206
        content = video.read_bytes()
        video.write_bytes(content + b"0")
        for path in ("film", "frames/4"):
            status, _, answer = client.of_page(path)
            assert status == 400
            assert "film.mp4: was removed or changed" in json.loads(answer)["problem"]
        video.unlink()
        assert client.of_page("film")[0] == 400
    assert "Traceback" not in caplog.text


def test_a_film_that_is_cut_off_while_it_is_sent_ends_the_request(tmp_path, monkeypatch, capfd):
    folder, _ = write_result(tmp_path)
    video = tmp_path / "large.mp4"
    video.write_bytes(bytes(80_000_000))
    monkeypatch.setattr(server, "film_times", lambda *_: [])
    with served(folder, video) as (client, _), socket.create_connection((HOST, client.port), timeout=30) as connection:
        connection.sendall(f"GET /{client.token}/film HTTP/1.1\r\nHost: {HOST}:{client.port}\r\n\r\n".encode())
        connection.recv(9)
        os.truncate(video, 1_000_000)
        while connection.recv(1 << 20):
            pass
    assert "Traceback" not in capfd.readouterr().err


def test_a_client_that_leaves_is_no_error(page, caplog, capfd):
    client, _, _ = page
    for request in (
        f"POST /{client.token}/change/edits HTTP/1.1\r\nHost: {HOST}:{client.port}\r\nContent-Length: 99\r\n\r\n[",
        f"GET /{client.token}/film HTTP/1.1\r\nHost: {HOST}:{client.port}\r\n\r\n",
    ):
        with socket.create_connection((HOST, client.port)) as connection:
            connection.sendall(request.encode())
    assert client.of_page("facts")[0] == 200
    assert "Traceback" not in caplog.text + capfd.readouterr().err


def test_a_link_may_lead_to_the_page_but_to_nothing_else(page):
    client, _, _ = page
    link = {"Sec_Fetch_Site": "cross-site", "Sec_Fetch_Mode": "navigate"}
    assert client.of_page("", **link)[0] == 200
    for path in ("facts", "film", "page/main.js", "results/0/rig"):
        assert client.of_page(path, **link)[0] == 403
    assert client.of_page("", method="POST", body=b"", **link)[0] == 403
    assert client.of_page("", Sec_Fetch_Site="cross-site", Sec_Fetch_Mode="cors")[0] == 403
    assert client.get("/", **link)[0] == 403


def wait_for(client):
    for _ in range(300):
        state = json.loads(client.of_page("work")[2])
        if state["done"]:
            return state
        time.sleep(0.02)
    raise AssertionError("the work does not end")


def test_work_appends_the_new_result_and_reports_failures(page, monkeypatch, tmp_path):
    client, viewer, _ = page
    other, _ = write_result(tmp_path)
    monkeypatch.setattr(session, "free_name", lambda folder, word: other)
    called = []

    def corrected(folder, out, edits, observations, progress):
        with progress("Fitting", 2) as report:
            report(1, "")
        called.append(list(map(str, edits)))

    monkeypatch.setattr(session, "correct_tracks", corrected)
    assert client.of_page("change/refit", method="POST", body=b'{"known": []}')[0] == 400  # no edits
    body = b'{"edits": ["delete 4"], "known": []}'
    client.of_page("change/edits", method="POST", body=body)
    known = b'{"known": ["delete 4"], "edits": []}'
    assert client.of_page("change/refit", method="POST", body=known)[0] == 200
    state = wait_for(client)
    assert (state["problem"], state["out"], called) == ("", str(other), [["delete 4"]])
    assert len(json.loads(client.of_page("facts")[2])["results"]) == 2
    viewer.results.pop()

    def failing(*_, **__):
        raise InputError("track 4", "cannot be fitted", "choose another")

    monkeypatch.setattr(session, "correct_tracks", failing)
    client.of_page("change/refit", method="POST", body=known)
    assert "track 4" in wait_for(client)["problem"]
    client.of_page("change/edits", method="POST", body=known)


def test_marked_frames_become_a_folder_for_labelling(page):
    client, viewer, _ = page
    assert client.of_page("change/mark", method="POST", body=b'{"frames": [5, 3, 5]}')[0] == 200
    state = wait_for(client)
    assert state["problem"] == ""
    out = viewer.session.folder.with_name("result-frames")
    assert state["out"] == str(out)
    assert sorted(path.name for path in (out / "images").iterdir()) == ["film_000003.png", "film_000005.png"]
    assert "marked by a person" in (out / "suggested.csv").read_text()
    client.of_page("change/mark", method="POST", body=b'{"frames": [400]}')
    assert "frame 400" in wait_for(client)["problem"]
    assert session.free_name(viewer.session.folder, "frames").name == "result-frames-2"


def test_only_this_computer_is_listened_to_and_a_port_in_use_is_an_error():
    sock = listening(None)
    host, port = sock.getsockname()
    assert host == HOST == "127.0.0.1"
    with pytest.raises(InputError, match=f"--port: is {port}, which cannot be used"):
        listening(port)
    sock.close()


def test_wrong_use_is_one_sentence(tmp_path, capsys):
    result, video = write_result(tmp_path)
    other = tmp_path / "other.mp4"
    other.write_bytes(video.read_bytes())
    rejected(capsys, ["view", str(result), "--video", str(tmp_path / "no.mp4")], "no.mp4")
    rejected(capsys, ["view", str(result), str(result), "--edits", "x.edits"], "--edits")
    rejected(capsys, ["view", str(result), "--frames", "900:901"], "900:901")
    rejected(capsys, ["view", str(tmp_path)], "poses.npz")
    (tmp_path / "wrong.edits").write_text("explode 4\n")
    rejected(capsys, ["view", str(result), "--edits", str(tmp_path / "wrong.edits")], "wrong.edits", "line 1")
    rejected(capsys, ["view", str(result), "--port", "99999999"], "--port")


def test_wrong_use_of_labelling_is_one_sentence(tmp_path, capsys):
    video = films.encode(tmp_path / "film.mp4", count=4)
    rejected(capsys, ["label", str(video), "--count", "5"], "has 4 frames", "give --count 4")
    rejected(capsys, ["label", str(video), "--birds", "0"], "--birds", "give 1 or more")
    rejected(capsys, ["label", str(tmp_path / "no.mp4")], "no.mp4")
    (tmp_path / "film.labels.json").write_text("{}")
    rejected(capsys, ["label", str(video), "--count", "2"], "film.labels.json", "was not written by", "another --out")


def test_labels_of_a_film_are_kept_when_labelling_goes_on(tmp_path, monkeypatch):
    """A second start with fewer frames and birds shows all frames and birds that have labels."""
    video, served = films.encode(tmp_path / "film.mp4", count=8), []
    (tmp_path / "film.labels.edits").write_text("place 4@5 bill_tip 10,12\n")
    monkeypatch.setattr("jaxfit.viewer.server.serve", lambda viewer, *_: served.append(viewer))
    assert main(["label", str(video), "--count", "1", "--birds", "1", "--no-browser"]) == 0
    (viewer,) = served
    assert 5 in viewer.results[0].frame_index
    assert len(viewer.results[0].facts()["tracks"]) == 4
    assert viewer.facts()["corrections"]["edits"] == ["place 4@5 bill_tip 10,12"]
    edits = ["place 4@5 bill_tip 10,12", "place 4@5 crown 30,20"]
    viewer.session.set_edits(edits, edits[:1])
    labels = read_coco(tmp_path / "film.labels.json")
    assert (labels.track_id.tolist(), labels.frame_index.tolist()) == ([4], [5])
    assert labels.box_px[0, 0].tolist() == [10, 12, 20, 8]


def test_the_browser_gets_a_private_page_and_not_the_address(tmp_path, monkeypatch, capsys):
    """All users of a computer see the arguments of programs; without a display, no browser is opened."""
    result, _ = write_result(tmp_path)
    opened = []

    def look(address):
        leading = Path(url2pathname(urlsplit(address).path))
        opened.append((address, leading.read_text(), stat.S_IMODE(leading.stat().st_mode)))

    monkeypatch.setattr(view.webbrowser, "open", look)
    monkeypatch.setattr(view.sys, "platform", "linux")
    monkeypatch.setattr(
        "jaxfit.viewer.server.serve", lambda viewer, sock, started: started("http://127.0.0.1:1/secret/")
    )
    for display, options in ((":0", []), (":0", ["--no-browser"]), ("", [])):
        for name in ("DISPLAY", "WAYLAND_DISPLAY"):
            monkeypatch.setenv(name, display)
        assert main(["view", str(result), *options]) == 0
        assert "http://127.0.0.1:1/secret/" in capsys.readouterr().out
    ((address, text, mode),) = opened
    assert "secret" not in address
    assert 'url=http://127.0.0.1:1/secret/"' in text
    assert mode == 0o600
    assert not list(tmp_path.glob("*.html"))
