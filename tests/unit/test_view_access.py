"""Who may steer the page of `quadrl view`, and with what: real clients, wrong ones among them."""

import contextlib
import random
import socket
import time
import types
import urllib.error
import urllib.request

import numpy as np
import pytest
from helpers import refused

from quadrl import tasks
from quadrl.aircraft.specification import resolve
from quadrl.base.errors import QuadrlError
from quadrl.core.scenario import Scenario
from quadrl.evaluation.controllers import make_controller
from quadrl.rendering.live.flight import Flight

viser = pytest.importorskip("viser")
import msgspec  # noqa: E402
import viser.infra._infra as infra  # noqa: E402
import zstandard  # noqa: E402
from websockets.datastructures import Headers  # noqa: E402
from websockets.exceptions import InvalidStatus  # noqa: E402
from websockets.sync.client import connect  # noqa: E402

from quadrl.rendering.live import access, browser  # noqa: E402

VEHICLE = resolve(None)
CAMERA = dict(wxyz=(1, 0, 0, 0), position=(0, -3, 2), look_at=(0, 0, 2), up_direction=(0, 0, 1))
CAMERA |= dict(fov=0.7, near=0.01, far=1000, image_height=480, image_width=640)
WRONG = (
    *(None, True, "", "nobody", "up2", "nan", "1e400", "9" * 400, [], [1.0, 2.0], {"a": 1}, b"\0"),
    *(0, -1, 10**6, 2**64 - 1, -(2**63), 1e300, -1e300, np.inf, -np.inf, np.nan, 1e-320),
)
LABELS = (
    *("flown by", "paused", "speed of time", "without end", "", "east", "north", "up", "calm"),
    *("by [m/s]", "to", "camera", "aircraft", "apart [m]", "goals and markers", "trails"),
)


def flying(count):
    task = tasks.make("hover")
    choices = {"geometric": lambda: make_controller("geometric", task, VEHICLE)}
    flight = Flight(choices["geometric"](), Scenario.of(task, vehicle=VEHICLE), num_envs=count)
    return contextlib.closing(browser.Page(flight, choices, port=0))


@pytest.fixture(scope="module")
def served():
    """A page that tests only knock at."""
    with flying(2) as page:
        page.frame(0.0)
        yield page


@pytest.fixture
def page(request):
    """A page of two aircraft, or of one, which a test may leave in any state."""
    with flying(getattr(request, "param", 2)) as page:
        page.frame(0.0)
        yield page


some = pytest.mark.parametrize("page", [1, 2], indirect=True)  # one has no other to look at


@contextlib.contextmanager
def client(page, host="localhost:{}", origin="http://localhost:{}", **options):
    """A connection to the page, which was reached by a name and comes from an origin."""
    port = page.server.get_port()
    with socket.create_connection(("localhost", port), timeout=20) as plug:
        address, origin = f"ws://{host.format(port)}/", origin and origin.format(port)
        settings = {"subprotocols": [f"viser-v{viser.__version__}"], "compression": None}
        settings |= {"max_size": None, "max_queue": 10_000, "origin": origin, "sock": plug}
        with connect(address, **settings, **options) as connection:
            yield connection


def send(connection, kind, **parts):
    connection.send(msgspec.msgpack.encode({"type": kind} | parts))


def put(connection, uuid, value):
    """Move a control."""
    send(connection, "GuiUpdateMessage", uuid=uuid, updates={"value": value})


def join(connection):
    """Be a client as viser counts them; returns what the page can be asked by: ids by labels."""
    send(connection, "ViewerCameraMessage", **CAMERA)
    found = {}
    while "Keys" not in found:
        frame = connection.recv(timeout=20)
        size = int.from_bytes(frame[8:16], "little")
        content = msgspec.msgpack.decode(zstandard.decompress(frame[16 : 16 + size]))
        for message in content["messages"]:
            if "label" in message.get("props", {}):
                found[message["props"]["label"]] = message["uuid"]
    return found


def until(fulfilled):
    end = time.monotonic() + 20
    while not fulfilled():
        assert time.monotonic() < end
        time.sleep(0.005)


def heard(page, connection, ids):
    """Wait until the page has heard all that was sent, by changing what is heard last."""
    sought = page.apart.value % 20.0 + 0.5
    put(connection, ids["apart [m]"], sought)
    until(lambda: page.apart.value == sought)


def controls(page):
    return [part for part in vars(page).values() if isinstance(part, browser.Control)] + page.wind


def check_sound(page):
    """The flight goes on, finite, and what it reads of its controls is within their bounds."""
    engine, count = page.flight.environment.engine, page.flight.environment.num_envs
    for array in (engine.qpos, engine.qvel, engine.act, engine.wind, page.flight.pose):
        assert np.isfinite(array).all()
    assert (np.abs(engine.wind) <= 10.0).all()
    assert 0.1 <= page.flight.speed <= 4.0 and 0.0 <= page.apart.value <= 20.0
    assert 0 <= page.row < count and 0.1 <= page.strength.value <= 5.0
    assert page.camera.value in browser.CAMERAS and page.flown_by.value in page.controllers


OWN = (
    *(("localhost:80", "http://localhost:80"), ("LocalHost:80", "http://localhost:80")),
    *(("127.0.0.1:80", "http://127.0.0.1:80"), ("[::1]:80", "http://[::1]:80")),
    *(("192.168.7.9:80", "http://192.168.7.9:80"), ("localhost", "https://localhost")),
    (f"{socket.gethostname()}:80", f"http://{socket.gethostname()}:80".lower()),
    ("lab.example:80", "http://lab.example:80"),  # as it was told to listen at
)
STRANGE = (
    *(("localhost:80", f"http://{origin}", "Origin") for origin in (
        *("stranger.example", "localhost:9", "127.0.0.1:80", "localhost:80.stranger.example"), ""
    )),
    *(("localhost:80", origin, "Origin") for origin in ("null", None)),
    *((host, f"http://{host}", "Host") for host in (  # DNS rebinding
        *("stranger.example:80", "localhost.stranger.example", "127.0.0.1.stranger.example"),
    )),
)  # fmt: skip


def test_only_the_page_itself_may_steer():
    for host, origin, *wrong in (*OWN, *STRANGE):
        origins = {} if origin is None else {"Origin": origin}
        headers = Headers(Host=host, Upgrade="websocket", **origins)
        said = access.refusal(headers, "lab.example")
        assert said is None if not wrong else said.startswith(f"{wrong[0]} is "), (host, origin)
    assert access.refusal(Headers(Host="lab.example:8080"), "0.0.0.0") is not None


def test_who_may_not_steer_is_not_let_in(served):
    with client(served, "localhost:9000", "https://localhost:9000") as connection:  # a tunnel
        ids = join(connection)
        put(connection, ids["north"], 3)
        heard(served, connection, ids)
        served.frame(VEHICLE.control_timestep)
    engine = served.flight.environment.engine
    np.testing.assert_array_equal(engine.wind, [[0.0, 3.0, 0.0]] * len(engine.wind))
    wrong = [{"origin": "http://stranger.example"}, {"host": "stranger.example:{}"}]
    twice = (("Origin", "http://localhost"), ("Host", "stranger.example"))
    wrong += [{"additional_headers": dict([header])} for header in twice]
    for options in wrong:
        with pytest.raises(InvalidStatus) as refused, client(served, **options):
            pass
        answer = refused.value.response
        assert answer.status_code == 403 and answer.body.decode().count("\n") == 1

    def fetch(host):
        request = urllib.request.Request(served.address, headers={"Host": host})
        with urllib.request.urlopen(request, timeout=20) as answer:
            return answer.read()

    assert b"<html" in fetch("localhost:9000")
    with pytest.raises(urllib.error.HTTPError, match="403"):
        fetch("stranger.example")


def test_a_viser_that_starts_another_server_is_not_served(monkeypatch):
    hidden = types.SimpleNamespace(serve=infra.websockets.asyncio.server.serve)
    parts = {"exceptions": infra.websockets.exceptions, "datastructures": None}
    other = types.SimpleNamespace(asyncio=types.SimpleNamespace(server=hidden), **parts)
    monkeypatch.setattr(infra, "websockets", other)
    started = []
    stop = viser.ViserServer.stop
    monkeypatch.setattr(viser.ViserServer, "stop", lambda it: (started.append(it), stop(it)))
    with refused(match="any web page"):
        flying(1)
    with socket.socket() as probe:
        assert probe.connect_ex(("localhost", started[0].get_port())) != 0


def test_messages_that_no_control_sends_do_nothing(page, monkeypatch):
    with client(page) as connection, client(page) as other:
        ids, _ = join(connection), join(other)
        opened = []
        monkeypatch.setattr(page.server, "request_share_url", lambda: opened.append("tunnel"))
        kept = len(page.server._websock_server._broadcast_buffer.message_from_id)
        for content in ("text", b"\xc1", msgspec.msgpack.encode([1, 2])):
            connection.send(content)
        send(connection, "ShareUrlRequest")
        for count in range(200):
            send(connection, "GuiFormDirtyMessage", uuid=str(count))
        for name, value in (("removed", True), ("props", "x"), ("update_cb", 7), ("uuid", "")):
            send(connection, "GuiUpdateMessage", uuid=ids["paused"], updates={name: value})
            both = {"value": False, name: value}
            send(connection, "GuiUpdateMessage", uuid=ids["east"], updates=both)
        put(connection, "of nobody", 1)
        heard(page, connection, ids)
        for _ in range(3):
            page.frame(VEHICLE.control_timestep)
        now = len(page.server._websock_server._broadcast_buffer.message_from_id)
        assert now < kept + 20 and not opened
        put(connection, ids["paused"], True)
        heard(page, connection, ids)
        page.frame(0.0)
    assert page.flight.paused


@pytest.mark.slow
@some
def test_whatever_a_client_sends_the_flight_goes_on(page):
    draw = random.Random(5)
    cameras = [{"look_at": CAMERA["position"]}, {"up_direction": (0, 0, 0)}, {"fov": np.inf}]
    cameras += [{"position": ("a", "b", "c")}, {"look_at": (np.nan,) * 3}]
    with client(page) as connection, client(page) as other:
        ids, _ = join(connection), join(other)
        assert set(LABELS) <= set(ids)
        for _ in range(60):
            send(connection, "ViewerCameraMessage", **(CAMERA | draw.choice(cameras)))
            put(connection, ids["camera"], draw.choice(browser.CAMERAS))
            for _ in range(20):
                put(connection, ids[draw.choice(LABELS)], draw.choice(WRONG))
                send(connection, "CommandTriggerMessage", uuid=draw.choice([*ids.values(), "x"]))
            page.frame(VEHICLE.control_timestep)
            check_sound(page)
        heard(page, connection, ids)
        page.frame(0.0)
        put(other, ids["paused"], False)
        heard(page, other, ids)
        flown = page._clock
        page.frame(1.0)
        check_sound(page)
    assert page._clock > flown
    for _ in range(200):  # whatever viser hands over
        for control in controls(page):
            control._handle._impl.value = draw.choice(WRONG)
        draw.choice([page._calm, page._pause, page._step_once])()
        page.frame(VEHICLE.control_timestep)
        check_sound(page)


@pytest.mark.parametrize("told", ["camera", "notice"])  # viser warns once of each browser
def test_a_browser_that_leaves_is_told_nothing_and_of_it_nobody(page, monkeypatch, told):
    def refuse():
        raise QuadrlError("Nothing flies this.")

    with client(page) as connection:
        join(connection)
        until(page.server.get_clients)
        clients = page.server.get_clients()
    until(lambda: not page.server.get_clients())
    monkeypatch.setattr(page.server, "get_clients", lambda: clients)
    if told == "camera":
        page.apart.value += 0.5
    else:
        page.controllers["nothing"] = refuse
        page.flown_by._choices = ("geometric", "nothing")
        page.flown_by._handle._impl.value = "nothing"
    page.frame(VEHICLE.control_timestep)
    assert page._viewed[1] == page.apart.value and page.flown_by.value == "geometric"


@some
def test_numbers_beyond_a_slider_are_its_ends_and_what_is_no_choice_changes_nothing(page):
    with client(page) as connection:
        ids = join(connection)
        for label, value in (("east", 1e8), ("north", -20), ("up", "nan"), ("camera", "nobody")):
            put(connection, ids[label], value)
        put(connection, ids["aircraft"], 10**6)
        heard(page, connection, ids)
        camera = page.camera.value
        page.frame(VEHICLE.control_timestep)
    np.testing.assert_array_equal(page.flight.wind, [10.0, -10.0, 0.0])
    assert page.row == page.flight.environment.num_envs - 1
    assert camera == ("follow" if page.row == 0 else "free")
    assert page.wind[0]._handle.value == 10.0  # which every browser shows


def test_key_presses_beyond_some_are_dropped(page):
    with client(page) as connection:
        ids = join(connection)
        for label in ("keyboard: forward", "one step"):
            for _ in range(2_000):
                send(connection, "CommandTriggerMessage", uuid=ids[label])
        heard(page, connection, ids)
        assert page._asked.qsize() == browser.MOST_ASKED
        page.frame(VEHICLE.control_timestep)
        assert page._asked.empty() and page.keyboard.action[0] == 1.0
        send(connection, "CommandTriggerMessage", uuid=ids["keyboard: stop"])
        until(lambda: page._asked.qsize())
        page.frame(VEHICLE.control_timestep)
    assert page.keyboard.action[0] == 0.0
