"""The server of `hma play`: messages, frames, and what it refuses."""

import asyncio
import json
import socket
import struct
import threading
from collections.abc import Iterator
from io import BytesIO
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from starlette.testclient import TestClient, WebSocketTestSession
from starlette.websockets import WebSocketDisconnect

from hma_data.episodes.images import decode_image
from hma_model.play import server
from hma_model.play.holding import Holding
from hma_model.play.messages import MAX_MESSAGE_BYTES
from hma_model.play.server import FRAMES_AHEAD, MESSAGE_BURST, SCENE_COST, Server
from hma_model.play.stepper import Stepper
from tests.model.true_world import TrueWorld, lab_robots

HOST, DRIVE = "http://127.0.0.1:8000", "ws://127.0.0.1:8000/drive"


@pytest.fixture
def stepper() -> Iterator[Stepper]:
    robots = lab_robots("mover_04", "arm2_12")
    made = Stepper(dict.fromkeys(robots, TrueWorld()), robots, most=3)
    made.start()
    yield made
    made.stop()


def test_robots_are_listed_by_how_long_they_hold(stepper: Stepper) -> None:
    known = {"mover_04": Holding(1.0, False, False), "arm2_12": Holding(8.2, False, True)}
    server = Server(stepper, "a model", holdings=known)
    with TestClient(server.app, HOST) as client, client.websocket_connect(DRIVE) as socket:
        listed = PageViewer(socket).message("hello")["robots"]
    said = [(one["id"], one["holds"], one["follows"]) for one in listed]
    assert said == [("arm2_12", "holds 8 s", True), ("mover_04", "does not follow its actions", False)]


def test_a_robot_of_two_checkpoints_holds_as_long_as_in_the_one_that_drives_it(monkeypatch) -> None:
    known, listed = {"one": Holding(1.0, False, True), "two": Holding(2.0, False, True)}, dict[str, Holding]()
    monkeypatch.setattr("hma_model.checkpoint.io.load", lambda *given: None)
    monkeypatch.setattr(server, "World", lambda *given: TrueWorld())
    monkeypatch.setattr(server, "holdings", lambda part: {"mover_04": known[part.name]})

    def listing(stepper: Any, name: str, host: str, token: None, first: None, held: Any) -> Any:
        listed.update(held)
        return SimpleNamespace(app=None)

    async def run(*given: Any) -> None: ...

    monkeypatch.setattr(server, "Server", listing)
    monkeypatch.setattr(server, "run", run)
    (robot,) = lab_robots("mover_04").values()
    parts = [
        server.Part(SimpleNamespace(name=name, config=SimpleNamespace(discrete=True)), None, {key: robot})  # type: ignore
        for name, key in (("one", "mover_04"), ("two", "mover_04:recordings"))
    ]
    asyncio.run(server.serve(parts, "models", None, "", None, lambda: None))  # type: ignore[arg-type]
    assert listed == {"mover_04": known["one"], "mover_04:recordings": known["two"]}


@pytest.fixture
def client(stepper: Stepper) -> Iterator[TestClient]:
    with TestClient(Server(stepper, "a model").app, HOST) as made:
        yield made


class PageViewer:
    def __init__(self, socket: WebSocketTestSession) -> None:
        self.socket = socket

    def send(self, do: str, **values: Any) -> None:
        self.socket.send_text(json.dumps({"do": do, **values}))

    def message(self, kind: str) -> dict[str, Any]:
        while True:
            received = self.socket.receive()
            if received["type"] == "websocket.close":
                raise WebSocketDisconnect(received["code"], received.get("reason"))
            if received.get("text") and (message := json.loads(received["text"]))["kind"] == kind:
                return message

    def frame(self) -> tuple[dict[str, Any], list[np.ndarray[Any, Any]]]:
        while True:
            data = self.socket.receive().get("bytes")
            if data:
                (size,) = struct.unpack(">H", data[:2])
                header, rest = json.loads(data[2 : 2 + size]), data[2 + size :]
                parts = [rest[: header["model"]], rest[header["model"] :]]
                return header, [decode_image(part, "frame") for part in parts if part]

    def open(self, robot: str = "mover_04") -> dict[str, Any]:
        self.send("open", robot=robot)
        opened = self.message("opened")
        self.see(self.frame()[0])
        return opened

    def see(self, header: dict[str, Any]) -> None:
        self.send("seen", serial=header["serial"])

    def works(self) -> None:
        self.send("step")
        header, _ = self.frame()
        self.see(header)
        assert header["frame"] >= 1


def test_the_page_allows_no_script_but_its_own(client: TestClient) -> None:
    answer = client.get("/")
    policy = answer.headers["content-security-policy"]
    nonce = policy.partition("'nonce-")[2].partition("'")[0]
    assert answer.status_code == 200 and "default-src 'none'" in policy and "unsafe" not in policy
    assert answer.text.count(f'nonce="{nonce}"') == 2 and "NONCE" not in answer.text


def test_a_page_opens_drives_and_sees_both_images(client: TestClient) -> None:
    with client.websocket_connect(DRIVE) as socket:
        page = PageViewer(socket)
        assert {robot["key"] for robot in page.message("hello")["robots"]} == {"mover_04", "arm2_12"}
        opened = page.open()
        assert [d["name"] for d in opened["robot"]["dimensions"]] == ["vx", "vy"] and opened["paused"]
        page.send("drive", action=[20, -10], input=7)
        page.send("run", on=True)
        for number in (1, 2, 3):
            header, images = page.frame()
            page.see(header)
            assert header["frame"] == number and header["input"] == 7 and header["action"] == [20, -10]
            assert [image.shape for image in images] == [(128, 128, 3)] * 2 and header["psnr"] == 60
        page.send("run", on=False)
        assert page.message("status")["paused"]


def test_a_action_far_outside_the_range_seen_in_training_is_told_once(client: TestClient) -> None:
    with client.websocket_connect(DRIVE) as socket:
        page = PageViewer(socket)
        ends = page.open()["robot"]["dimensions"][0]
        page.send("drive", action=[2 * ends["high"], 0], input=1)
        assert f"vx {ends['low']:g} to {ends['high']:g}" in page.message("error")["text"]
        page.send("drive", action=[3 * ends["high"], 0], input=2)
        page.send("step")
        received = []
        while not (data := socket.receive()).get("bytes"):
            received.append(json.loads(data["text"])["kind"])
        assert "error" not in received
        (size,) = struct.unpack(">H", data["bytes"][:2])
        assert json.loads(data["bytes"][2 : 2 + size])["action"][0] == pytest.approx(3 * ends["high"])


def test_a_reload_goes_on_where_it_was(client: TestClient) -> None:
    with client.websocket_connect(DRIVE) as socket:
        page = PageViewer(socket)
        name = page.open()["session"]
        page.works()
    with client.websocket_connect(DRIVE) as socket:
        page = PageViewer(socket)
        page.send("resume", session=name)
        opened = page.message("opened")
        assert opened["frame"] == 1 and opened["scores"] == [[1, 60.0, 60.0]]
        page.send("step")
        assert [page.frame()[0]["frame"] for _ in range(2)] == [1, 2]
        page.send("resume", session="../../etc/passwd")
        assert "has ended" in page.message("gone")["text"]


def test_a_page_that_reads_nothing_skips_frames_and_gets_the_latest(client, stepper) -> None:
    with client.websocket_connect(DRIVE) as socket:
        page = PageViewer(socket)
        session, seen = stepper.sessions[page.open()["session"]], []
        for count in range(1, 9):
            page.send("step")
            while session.count < count:
                stepper.call(lambda: None).result(10)
            if count <= FRAMES_AHEAD:
                seen.append(page.frame()[0])
        stepper.call(lambda: None).result(10)  # between two steps: the last one has ended
        assert [header["frame"] for header in seen] == [1, 2]
        page.see(seen[-1])
        assert page.frame()[0]["frame"] == 8


def test_a_page_that_leaves_while_its_robot_is_opened_keeps_no_session(client, stepper, monkeypatch) -> None:
    robot, begun, left = stepper.robots["mover_04"], threading.Event(), threading.Event()
    made = robot.scene(0)
    monkeypatch.setattr(robot, "scene", lambda number: (begun.set(), left.wait(10)) and made)
    with client.websocket_connect(DRIVE) as socket:
        PageViewer(socket).send("open", robot="mover_04")
        assert begun.wait(10)
    left.set()
    watching = stepper.call(lambda: [one.viewer for one in stepper.sessions.values()])
    assert watching.result(10) == [None]


def test_a_page_ends_no_session_that_another_page_drives_now(client: TestClient, stepper: Stepper) -> None:
    with client.websocket_connect(DRIVE) as first, client.websocket_connect(DRIVE) as second:
        one, other = PageViewer(first), PageViewer(second)
        name = one.open()["session"]
        other.send("resume", session=name)
        other.see(other.frame()[0])
        one.open("arm2_12")
        other.works()
        assert len(stepper.sessions) == 2


def test_a_robot_that_cannot_be_opened_leaves_the_session_as_it_is(client, stepper, monkeypatch) -> None:
    monkeypatch.setattr(stepper, "most", 1)
    monkeypatch.setattr(stepper.robots["arm2_12"], "scene", None)
    with client.websocket_connect(DRIVE) as socket:
        page = PageViewer(socket)
        page.open()
        for robot in ("nobody", "arm2_12"):
            page.send("open", robot=robot)
            page.message("error")
            page.works()
        page.open()
        page.works()
        assert len(stepper.sessions) == 1


WRONG = {
    "no JSON": "{",
    "no object": "[]",
    "unknown": '{"do": "remove"}',
    "another field": '{"do": "step", "path": "/etc"}',
    "NaN": '{"do": "drive", "action": [NaN, 0], "input": 1}',
    "infinite": '{"do": "drive", "action": [1e999, 0], "input": 1}',
    "infinite as float32": '{"do": "drive", "action": [1e300, 0], "input": 1}',
    "text": '{"do": "drive", "action": ["1", "2"], "input": 1}',
    "deep": "[" * 5000,
    "huge": '{"do": "resume", "session": "' + "x" * MAX_MESSAGE_BYTES + '"}',
    "passes": '{"do": "sample", "unmask_steps": 1000000, "temperature": 0, "order": "random"}',
    "scene": '{"do": "scene", "number": -1}',
}


@pytest.mark.parametrize("text", WRONG.values(), ids=WRONG)
def test_a_malformed_message_closes_its_connection_alone(client: TestClient, text: str) -> None:
    with client.websocket_connect(DRIVE) as good, client.websocket_connect(DRIVE) as bad:
        PageViewer(good).open()
        PageViewer(bad).open()
        bad.send_text(text)
        with pytest.raises(WebSocketDisconnect) as closed:
            PageViewer(bad).message("never")
        assert closed.value.code == 1008 and closed.value.reason
        PageViewer(good).works()


def test_a_flood_and_bytes_close_their_connections_alone(client, monkeypatch) -> None:
    monkeypatch.setattr(server, "MESSAGES_PER_S", 0.0)  # time restores no credit
    with client.websocket_connect(DRIVE) as good:
        PageViewer(good).open()
        with client.websocket_connect(DRIVE) as bad:
            for _ in range(int(MESSAGE_BURST) + 1):
                PageViewer(bad).send("seen", serial=0)
            with pytest.raises(WebSocketDisconnect, match="1008"):
                PageViewer(bad).message("never")
        with client.websocket_connect(DRIVE) as bad:
            bad.send_bytes(b"\0" * 10)
            with pytest.raises(WebSocketDisconnect, match="1008"):
                PageViewer(bad).message("never")
        PageViewer(good).works()


@pytest.mark.parametrize("do", ["open", "scene", "sync"])
def test_a_page_cannot_begin_scenes_so_often_that_the_others_wait(client, stepper, monkeypatch, do) -> None:
    monkeypatch.setattr(server, "MESSAGES_PER_S", 0.0)  # time restores no credit
    values = {"open": {"robot": "mover_04"}, "scene": {"number": 1}, "sync": {}}[do]
    world, _ = stepper._worlds["mover_04"]
    assert isinstance(world, TrueWorld)
    with client.websocket_connect(DRIVE) as bad:
        PageViewer(bad).open()
        with pytest.raises(WebSocketDisconnect, match="1008"):
            for _ in range(50):
                PageViewer(bad).send(do, **values)
            PageViewer(bad).message("never")
        stepper.call(lambda: None).result(10)
        assert 5 <= len(world.begun) <= MESSAGE_BURST / SCENE_COST


def test_wrong_values_are_told_and_the_session_goes_on(client: TestClient, stepper: Stepper) -> None:
    with client.websocket_connect(DRIVE) as socket:
        page = PageViewer(socket)
        page.send("open", robot="nobody")
        assert "there is no 'nobody'" in page.message("error")["text"]
        page.open()
        stepper.orders = ("random",)
        page.send("sample", unmask_steps=2, temperature=0, order="confidence")
        assert "no 'confidence' — known: random" in page.message("error")["text"]
        page.send("drive", action=[1, 2, 3], input=1)
        assert "has 3 values, this robot takes 2" in page.message("error")["text"]
        page.works()


@pytest.mark.parametrize(
    "headers",
    [{"Host": "evil.example"}, {"Origin": "http://evil.example"}, {"Origin": "null"}, {"Host": "[::1"}],
)
def test_foreign_hosts_and_origins_are_refused(client: TestClient, headers: dict[str, str]) -> None:
    assert client.get("/", headers=headers).status_code == 403
    with (
        pytest.raises(WebSocketDisconnect) as refused,
        client.websocket_connect(DRIVE, headers={"Host": "127.0.0.1:8000", **headers}),
    ):
        pass
    assert "refused" in refused.value.reason


def test_its_own_origin_is_let_in(client: TestClient) -> None:
    own = {"Host": "127.0.0.1:8000", "Origin": HOST}
    with client.websocket_connect(DRIVE, headers=own) as socket:
        PageViewer(socket).message("hello")


def test_a_token_is_needed_where_one_is_set(stepper: Stepper, monkeypatch) -> None:
    app = Server(stepper, "a model", "0.0.0.0", "a&b é").app
    page = "/?token=a%26b%20%C3%A9"
    monkeypatch.setattr(socket, "gethostname", lambda: "Lab-Mac.local")  # browsers send it in lower case
    with TestClient(app, "http://lab-mac.local:8000") as client:
        assert client.get(page).status_code == 200
    with TestClient(app, "http://192.168.1.7:8000") as client:
        assert [client.get(path).status_code for path in ("/", "/?token=wr%F6ng", page)] == [
            403, 403, 200,
        ]  # fmt: skip
        with pytest.raises(WebSocketDisconnect), client.websocket_connect(DRIVE):
            pass
        assert client.get(page, headers={"Host": "evil.example"}).status_code == 403


def test_what_was_driven_is_saved(client: TestClient) -> None:
    import av

    with client.websocket_connect(DRIVE) as socket:
        page = PageViewer(socket)
        name = page.open()["session"]
        assert client.get(f"/save?kind=mp4&session={name}").status_code == 409
        for _ in range(3):
            page.works()
        answer = client.get(f"/save?kind=mp4&session={name}")
        assert 'filename="mover_04-scene-0.mp4"' in answer.headers["content-disposition"]
        with av.open(BytesIO(answer.content)) as film:
            assert sum(1 for _ in film.decode(video=0)) == 4  # and the prompt's last frame
        said = [page.message("saving") for _ in range(2)]
        assert [(one["file"], one["text"]) for one in said] == [
            ("mp4", "writing frames"),
            ("mp4", "encoding the film"),
        ]
        assert said[0]["done"] == 1 and said[1]["done"] == said[1]["total"] == 4
        assert client.get(f"/save?kind=gif&session={name}").content[:6] == b"GIF89a"
    for query in ("kind=mp4&session=../../etc/passwd", f"kind=../page&session={name}", ""):
        assert client.get(f"/save?{query}").status_code == 404
