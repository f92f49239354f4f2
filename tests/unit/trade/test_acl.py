"""The transport's rules made from a policy pin every identity to its keys: bare sessions try what no container would.

A star whose middle holds the rules; user names, which the end that is dialled knows, stand for certificates there.
"""

import contextlib
import itertools
import json
import queue
import shutil
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final

import pytest
import zenoh

from tests.support.policies import policy_text
from trade import Container, Settings, service, where
from trade._security.network_crossings import crossings
from trade._security.policy import Policy, Role
from trade._security.policy_file import read_policy
from trade._security.zenoh_acl import acl
from trade.transport.endpoints import free_endpoint
from trade.transport.zenoh import ZenohTransport, configuration

pytestmark = pytest.mark.virtual_time

POLICY: Final = policy_text(
    "planner=operator drv=driver dash=viewer mallory=operator,driver thief=operator,driver",
    head='revoked = ["thief"]\n',
    operator="call=rosie.neck,lab read=rosie.neck",
    driver="register=rosie.neck",
    viewer="read=lab",
)
SYSTEM: Final = "rules"
STAR: Final = ("planner", "drv", "dash", "mallory")
HEARD: Final = ("stream/rosie.neck/*/*/*/*/*/*", "stream/rosie.neck.$*/*/*/*/*/*/*", "stream/**")
WAIT_S: Final = 20.0
"""Before something that is to come is given up."""
MANY: Final = 200


@pytest.fixture(scope="module")
def policy(tmp_path_factory: pytest.TempPathFactory) -> Policy:
    path = tmp_path_factory.mktemp("policy") / "policy.toml"
    path.write_text(POLICY)
    return read_policy(path)


class Star:
    """Clients that know each other only through the session in the middle, which goes by the rules."""

    def __init__(self, folder: Path, rules: dict[str, Any], stack: contextlib.ExitStack) -> None:
        self.numbers = itertools.count(2)
        users = folder / "users"
        users.write_text("".join(f"{name}:secret of {name}\n" for name in STAR))
        endpoint = free_endpoint()
        middle = {
            "mode": "router",
            "listen/endpoints": [endpoint],
            "transport/auth/usrpwd/dictionary_file": str(users),
            **rules,
        }
        stack.enter_context(_opened(middle))
        self.sessions = {
            name: stack.enter_context(
                _opened(
                    {
                        "mode": "client",
                        "connect/endpoints": [endpoint],
                        "namespace": SYSTEM,
                        "transport/auth/usrpwd/user": name,
                        "transport/auth/usrpwd/password": f"secret of {name}",
                    }
                )
            )
            for name in STAR
        }
        self.heard = {name: self._listen(name) for name in STAR}
        for actor, receiver in itertools.permutations(STAR, 2):
            self.put(actor, receiver)

    def _listen(self, name: str) -> queue.SimpleQueue[str]:
        """One queue for all that a container of that name subscribes to, and for more than it may."""
        heard: queue.SimpleQueue[str] = queue.SimpleQueue()
        hear = zenoh.handlers.Callback(lambda sample: heard.put(str(sample.key_expr)), indirect=False)  # so in order
        own = [f"{kind}/*/{name}/**" for kind in ("call", "stop", "reply")]
        for pattern in (*own, "estop/**", "registry/**", "**", "call/**", "reply/**", *HEARD):
            self.sessions[name].declare_subscriber(pattern, hear, allowed_origin=zenoh.Locality.REMOTE)
        return heard

    def put(self, actor: str, receiver: str, *keys: str) -> list[str]:
        """Let one put on these keys; what the other one has heard of that.

        Behind them goes what every identity may send, of the same kind, as kinds overtake each other.
        """
        kind, heard, deadline = "call" if keys and keys[0].startswith("call/") else "stop", list[str](), _soon(WAIT_S)
        for key in keys:
            self.sessions[actor].put(key, b"", congestion_control=zenoh.CongestionControl.BLOCK)
        while time.monotonic() < deadline:
            mark = f"{kind}/{actor}/{receiver}/c/e1/trade/mark-{time.monotonic_ns()}"
            self.sessions[actor].put(mark, b"")
            heard += self._heard_until(receiver, mark, _soon(0.2))
            if mark in heard:
                return [key for key in heard if key in keys]
        pytest.fail(f"{receiver} hears nothing of {actor}")

    def _heard_until(self, receiver: str, mark: str, deadline: float) -> list[str]:
        heard = list[str]()
        while mark not in heard:
            try:
                heard.append(self.heard[receiver].get(timeout=max(0.0, deadline - time.monotonic())))
            except queue.Empty:
                break
        return heard


def _soon(wait_s: float) -> float:
    return time.monotonic() + wait_s


def _opened(settings: dict[str, Any]) -> zenoh.Session:
    config = zenoh.Config()
    for key, value in {"scouting/multicast/enabled": False, **settings}.items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


@pytest.fixture(scope="module")
def star(policy: Policy, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Star]:
    rules = acl(policy, namespace=SYSTEM, subject="usernames")
    with contextlib.ExitStack() as stack:
        yield Star(tmp_path_factory.mktemp("star"), rules, stack)


PUTS: Final = {
    # what: who puts it, who hears it, on which key, whether it passes
    "a call": ("planner", "drv", "call/planner/drv/c/e1/rosie.neck/P", True),
    "a call beneath the group": ("planner", "drv", "call/planner/drv/c/e1/rosie.neck.pan/P", True),
    "a call to the middleware": ("dash", "drv", "call/dash/drv/c/e1/trade/system", True),
    "a call to read": ("dash", "drv", "call/dash/drv/c/e1/lab/P", True),
    "a call above the group": ("planner", "drv", "call/planner/drv/c/e1/rosie/P", False),
    "a call to a group that begins alike": ("planner", "drv", "call/planner/drv/c/e1/rosie.necklace/P", False),
    "a call to a group of others": ("dash", "drv", "call/dash/drv/c/e1/rosie.neck/P", False),
    "a call to what has no group": ("planner", "drv", "call/planner/drv/c/e1/_/P", False),
    "a forged call": ("mallory", "drv", "call/planner/drv/c/e1/rosie.neck/P", False),
    "a forged call to the middleware": ("mallory", "drv", "call/planner/drv/c/e1/trade/system", False),
    "a call to all containers": ("mallory", "drv", "call/*/drv/c/e1/rosie.neck/P", False),
    "a stop without a role": ("dash", "drv", "stop/dash/drv/c/e1/rosie.neck/P", True),
    "a forged stop": ("mallory", "drv", "stop/planner/drv/c/e1/rosie.neck/P", False),
    "an answer": ("drv", "planner", "reply/drv/planner/c/e1", True),
    "a forged answer": ("mallory", "planner", "reply/drv/planner/c/e1", False),
    "an answer in the callers name": ("mallory", "planner", "reply/planner/planner/c/e1", False),
    "an entry": ("drv", "planner", "registry/rosie.neck/drv/c/e1/P", True),
    "an entry of the middleware": ("dash", "planner", "registry/trade/dash/c/e1/system", True),
    "an entry in a group of others": ("drv", "planner", "registry/lab/drv/c/e1/P", False),
    "an entry of a reader": ("dash", "planner", "registry/rosie.neck/dash/c/e1/P", False),
    "a forged entry": ("mallory", "planner", "registry/rosie.neck/drv/c/e1/P", False),
    "a forged tally": ("mallory", "planner", "registry/trade/drv/c/e1/tally", False),
    "an entry one may not see": ("drv", "dash", "registry/rosie.neck/drv/c/e1/P", False),
    "a sample": ("drv", "planner", "stream/rosie.neck/drv/c/e1/P/angle/20", True),
    "a sample beneath the group": ("drv", "planner", "stream/rosie.neck.pan/drv/c/e1/P/angle/20", True),
    "a sample of a group of others": ("drv", "planner", "stream/lab/drv/c/e1/P/angle/20", False),
    "a forged sample": ("mallory", "planner", "stream/rosie.neck/drv/c/e1/P/angle/20", False),
    "a sample one may not read": ("drv", "dash", "stream/rosie.neck/drv/c/e1/P/angle/20", False),
    "a sample to all containers": ("drv", "planner", "stream/*/drv/c/e1/P/angle/20", False),
    "a sample of a reader": ("dash", "planner", "stream/rosie.neck/dash/c/e1/P/angle/20", False),
    "an e-stop": ("dash", "drv", "estop/dash", True),
    "a forged e-stop": ("mallory", "drv", "estop/planner", False),
    "a confirmation": ("drv", "dash", "estop/drv/c/e1", True),
    "a forged confirmation": ("mallory", "dash", "estop/drv/c/e1", False),
    "an overheard call": ("planner", "mallory", "call/planner/drv/c/e1/rosie.neck/P", False),
    "an overheard answer": ("drv", "mallory", "reply/drv/planner/c/e1", False),
}


@pytest.mark.real_clock
@pytest.mark.parametrize(("actor", "receiver", "key", "passes"), PUTS.values(), ids=list(PUTS))
def test_the_rules_pass_what_the_policy_allows(star: Star, actor: str, receiver: str, key: str, passes: bool) -> None:
    fresh = key.replace("/e1", f"/e{next(star.numbers)}")  # what comes twice may still wait from the test before
    assert bool(star.put(actor, receiver, fresh)) is passes


@pytest.mark.real_clock
def test_a_session_declares_only_its_own_liveliness(star: Star) -> None:
    signs: queue.SimpleQueue[str] = queue.SimpleQueue()
    reader, forger = star.sessions["planner"].liveliness(), star.sessions["mallory"].liveliness()
    watch = reader.declare_subscriber("alive/**", lambda sample: signs.put(str(sample.key_expr)), history=True)
    before = forger.declare_token("alive/mallory/c/e0")
    assert signs.get(timeout=WAIT_S) == "alive/mallory/c/e0"  # from here on signs come in the order they are given in
    forged, own = forger.declare_token("alive/drv/c/e1"), forger.declare_token("alive/mallory/c/e1")
    assert signs.get(timeout=WAIT_S) == "alive/mallory/c/e1"
    real = star.sessions["drv"].liveliness().declare_token("alive/drv/c/e1")
    assert signs.get(timeout=WAIT_S) == "alive/drv/c/e1"
    for declared in (watch, before, forged, own, real):
        declared.undeclare()


def asked(star: Star, reader: str, pattern: str) -> list[str]:
    replies = star.sessions[reader].get(
        pattern,
        zenoh.handlers.FifoChannel(64),
        target=zenoh.QueryTarget.ALL,
        consolidation=zenoh.ConsolidationMode.NONE,
        timeout=2.0,
    )
    return sorted(str(reply.ok.key_expr) for reply in replies if reply.ok is not None)


def answering(star: Star, who: str, pattern: str, *keys: str) -> Any:
    def answer(query: zenoh.Query) -> None:
        for key in keys:
            if query.key_expr.intersects(key):
                query.reply(key, b"")

    return star.sessions[who].declare_queryable(pattern, answer)


def asked_until(star: Star, reader: str, pattern: str, expected: list[str]) -> bool:
    deadline = time.monotonic() + WAIT_S
    while (got := asked(star, reader, pattern)) != expected and time.monotonic() < deadline:
        pass
    return got == expected


@pytest.mark.real_clock
def test_only_the_container_itself_answers_for_what_it_offers(star: Star) -> None:
    drv, mallory = "registry/*/drv/c/e1/*", "registry/*/mallory/c/e1/*"
    forged, own = "registry/rosie.neck/drv/c/e1/P", "registry/rosie.neck/mallory/c/e1/P"
    with contextlib.ExitStack() as stack:
        stack.callback(answering(star, "mallory", drv, forged).undeclare)
        stack.callback(answering(star, "mallory", mallory, own, forged).undeclare)
        assert asked_until(star, "planner", mallory, [own])
        assert asked(star, "planner", drv) == []
        assert asked(star, "planner", "registry/**") == [own]
        entries = ["registry/lab/drv/c/e1/L", "registry/rosie.neck/drv/c/e1/P", "registry/trade/drv/c/e1/system"]
        stack.callback(answering(star, "drv", drv, *entries).undeclare)
        assert asked_until(star, "planner", drv, entries[1:])  # it may not offer the first
        assert asked(star, "dash", drv) == entries[2:]  # nor may that one see the second


def test_an_identity_without_a_role_or_revoked_has_no_rules(policy: Policy) -> None:
    rules = acl(policy, namespace=SYSTEM, identities=[*STAR, "thief"])["access_control"]
    assert rules["default_permission"] == "deny"
    assert [subject["id"] for subject in rules["subjects"]] == list(STAR)
    assert not any("thief" in json.dumps(rule) for rule in rules["rules"])


def test_a_gateway_is_believed_and_every_key_is_of_the_system(policy: Policy) -> None:
    trusting = Policy(policy.roles.values(), policy.identities, gateways=["edge"])
    rules = acl(trusting, namespace=SYSTEM)["access_control"]["rules"]
    assert all(key.startswith(f"{SYSTEM}/") for rule in rules for key in rule["key_exprs"])
    believed = [rule for rule in rules if rule["id"].startswith("edge ")]
    assert {key for rule in believed for key in rule["key_exprs"]} == {f"{SYSTEM}/**"}


def keys_of(rules: dict[str, Any], who: str, message: str, flow: str) -> set[str]:
    """What that subject may, without the system."""
    found = [rule for rule in rules["access_control"]["rules"] if rule["id"] == f"{who} {flow} {message}"]
    return {key.partition("/")[2] for rule in found for key in rule["key_exprs"]}


def test_what_a_network_does_not_export_is_neither_offered_nor_called_across_it() -> None:
    roles = [Role("all", {"call": ["*"], "read": ["*"], "register": ["rosie", "lab"]})]
    policy = Policy(roles, {"rosie": ["all"], "planner": ["all"]})
    crossing = crossings({"eth0": ["rosie.head"], "eth1": []})
    assert crossing == {"eth0": (["rosie.head"], [], {}, {}), "eth1": ([], ["rosie.head"], {}, {})}
    rules = acl(policy, namespace=SYSTEM, networks={("eth0", "lo"): crossing["eth0"], ("eth1",): crossing["eth1"]})
    subjects = {subject["id"]: subject for subject in rules["access_control"]["subjects"]}
    assert subjects["rosie eth0 lo"]["interfaces"] == ["eth0", "lo"]
    assert subjects["planner eth1"]["cert_common_names"] == ["planner"]
    offered = {key for key in keys_of(rules, "rosie eth0 lo", "put", "ingress") if key.startswith("registry/")}
    assert offered == {f"registry/{group}/rosie/*/*/*" for group in ("trade", "rosie.head", "rosie.head.$*")}
    called = {key for key in keys_of(rules, "planner eth1", "put", "ingress") if key.startswith("call/")}
    assert called == {f"call/planner/*/*/*/{group}/*" for group in ("trade", "rosie.head", "rosie.head.$*")}
    seen = keys_of(rules, "planner eth0 lo", "reply", "egress")
    assert seen == {"registry/trade/*/*/*/*"}
    assert "stop/planner/**" in keys_of(rules, "planner eth1", "put", "ingress")
    exported = {f"stream/{group}/*/*/*/*/*/*" for group in ("trade", "rosie.head", "rosie.head.$*")}
    for message, flow in (("put", "egress"), ("declare_subscriber", "ingress")):
        heard = keys_of(rules, "planner eth1", message, flow)
        assert {key for key in heard if key.startswith("stream/")} == exported
        unheard = keys_of(rules, "planner eth0 lo", message, flow)
        assert {key for key in unheard if key.startswith("stream/")} == {"stream/trade/*/*/*/*/*/*"}


def rates_of(keys: set[str], group: str) -> set[str]:
    """At which streams of a group pass."""
    return {key.rpartition("/")[2] for key in keys if key.startswith(f"stream/{group}/")}


def test_streams_of_what_is_limited_pass_at_rates_up_to_that() -> None:
    limits = {"eth0": {"rosie": 5, "rosie.imu": 20}, "eth2": {"rosie": 10}}
    exports = {"eth0": ["rosie", "rosie.imu", "lab"], "eth1": [], "eth2": ["rosie"]}
    crossing = crossings(exports, limits)
    assert crossing["eth1"].seen_hz == {"rosie": 10, "rosie.imu": 20}
    rules = acl(None, namespace=SYSTEM, networks={(name,): what for name, what in crossing.items()})
    for who, message, flow, rosie in (
        ("* eth0", "put", "ingress", {"0.$*", "1", "2", "5"}),
        ("* eth0", "liveliness_token", "ingress", {"0.$*", "1", "2", "5"}),
        ("* eth1", "put", "egress", {"0.$*", "1", "2", "5", "10"}),
        ("* eth1", "liveliness_token", "egress", {"0.$*", "1", "2", "5", "10"}),
        ("* eth1", "declare_subscriber", "ingress", {"0.$*", "1", "2", "5", "10"}),
    ):
        keys = keys_of(rules, who, message, flow)
        assert rates_of(keys, "rosie") == rosie
        assert rates_of(keys, "rosie.imu") == {"0.$*", "1", "2", "5", "10", "20"}
        assert rates_of(keys, "lab") == {"*"}


def test_without_certificates_only_what_crosses_is_looked_at() -> None:
    crossing = crossings({"eth0": ["rosie"], "eth1": ["*"]})
    rules = acl(None, namespace=SYSTEM, networks={(name,): what for name, what in crossing.items()})
    assert all("cert_common_names" not in subject for subject in rules["access_control"]["subjects"])
    assert keys_of(rules, "* eth1", "reply", "egress") == {
        f"registry/{group}/*/*/*/*" for group in ("trade", "rosie", "rosie.$*")
    }
    assert keys_of(rules, "* eth0", "reply", "egress") == {"registry/*/*/*/*/*"}


@pytest.mark.real_clock
def test_calls_sent_at_once_all_pass_and_follow_behind_stops(star: Star) -> None:
    heard: queue.SimpleQueue[tuple[str, str]] = queue.SimpleQueue()
    hear = zenoh.handlers.Callback(
        lambda sample: heard.put((str(sample.key_expr), str(sample.priority))), indirect=False
    )
    subscribed = [star.sessions["drv"].declare_subscriber(f"{kind}/*/drv/b/**", hear) for kind in ("call", "stop")]
    urgent = {"congestion_control": zenoh.CongestionControl.BLOCK, "priority": zenoh.Priority.REAL_TIME}
    star.put("planner", "drv")  # what is subscribed to is known to all by the time that this is heard
    for number in range(MANY):
        star.sessions["planner"].put(f"call/planner/drv/b/e1/lab/P{number}", b"", **urgent)
    star.sessions["planner"].put("stop/planner/drv/b/e1/lab/P", b"", **urgent)
    got = [heard.get(timeout=WAIT_S) for _ in range(MANY + 1)]
    assert {priority for key, priority in got if key.startswith("call/")} == {str(zenoh.Priority.DATA_LOW)}
    assert {priority for key, priority in got if key.startswith("stop/")} == {str(zenoh.Priority.REAL_TIME)}
    for one in subscribed:
        one.undeclare()


@pytest.mark.real_clock
def test_a_flood_of_calls_is_cut_and_stops_are_not(policy: Policy, tmp_path: Path) -> None:
    rules = acl(policy, namespace=SYSTEM, subject="usernames", calls_hz=10)
    with contextlib.ExitStack() as stack:
        star = Star(tmp_path, rules, stack)
        calls = star.put("planner", "drv", *(f"call/planner/drv/c/e1/lab/P{number}" for number in range(MANY)))
        stops = star.put("planner", "drv", *(f"stop/planner/drv/c/e1/lab/P{number}" for number in range(MANY)))
    assert 1 <= len(set(calls)) < MANY // 2
    assert len(set(stops)) == MANY


class Neck:
    @service
    def move(self, angle_rad: float) -> float:
        return angle_rad

    @service(effect="read")
    def angle(self) -> float:
        return 0.5

    @service(effect="stop")
    def stop(self) -> None: ...


@pytest.fixture(scope="module")
def certificates(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with an authority and a certificate for each identity."""
    if shutil.which("openssl") is None:
        pytest.skip("needs the program openssl, to make certificates")
    folder = tmp_path_factory.mktemp("certificates")
    (folder / "kind").write_text("subjectAltName=IP:127.0.0.1\nextendedKeyUsage=serverAuth,clientAuth\n")
    new = ("-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes")
    _openssl(folder, "req", "-x509", *new, "-keyout", "ca.key", "-out", "ca.pem", "-days", "2", "-subj", "/CN=ca")
    for name in STAR:
        _openssl(folder, "req", *new, "-keyout", f"{name}.key", "-out", f"{name}.csr", "-subj", f"/CN={name}")
        signed = ("-in", f"{name}.csr", "-out", f"{name}.pem", "-days", "2", "-extfile", "kind")
        _openssl(folder, "x509", "-req", "-CA", "ca.pem", "-CAkey", "ca.key", "-CAcreateserial", *signed)
    return folder


def _openssl(folder: Path, *arguments: str) -> None:
    subprocess.run(["openssl", *arguments], cwd=folder, check=True, capture_output=True)


Join = Callable[[str], Container]


@pytest.fixture
def join(certificates: Path, policy: Policy, tmp_path: Path) -> Iterator[Join]:
    """Starts the container of an identity with its certificate, linked to those before it."""
    file = tmp_path / "policy.toml"
    file.write_text(POLICY)
    with contextlib.ExitStack() as stack:
        endpoints = list[str]()

        def start(name: str) -> Container:
            endpoint = free_endpoint().replace("tcp/", "tls/")
            settings = {
                **configuration(
                    namespace=SYSTEM, listen=[endpoint], connect=endpoints, credentials=("system", "secret")
                ),
                **acl(policy, namespace=SYSTEM),
                "transport/link/tls/root_ca_certificate": str(certificates / "ca.pem"),
                "transport/link/tls/enable_mtls": True,
                **{
                    f"transport/link/tls/{end}_{part}": str(certificates / f"{name}.{suffix}")
                    for end in ("listen", "connect")
                    for part, suffix in (("private_key", "key"), ("certificate", "pem"))
                },
            }
            endpoints.append(endpoint)
            return stack.enter_context(
                Container(
                    Settings(system=SYSTEM, identity=name, container=f"of-{name}", policy=file),
                    transport=ZenohTransport(settings),
                )
            )

        yield start


@pytest.mark.realtime
def test_containers_do_all_they_may_under_the_rules(
    join: Join, eventually: Callable[[Callable[[], bool]], bool]
) -> None:
    drv = join("drv")
    neck, arm = Neck(), Neck()
    drv.register(neck, "rosie.neck")
    planner = join("planner")
    call = {name: planner.find(where(name=name, group="rosie.neck"), wait_s=WAIT_S) for name in ("move", "angle")}
    assert (call["move"](0.1), call["angle"]()) == (0.1, 0.5)
    with planner.stream(call["angle"], hz=100) as angles:
        assert [angles.next(WAIT_S).value for _ in range(3)] == [0.5] * 3
    planner.call(where(name="stop"))
    drv.register(arm, "rosie.neck.left")
    assert planner.find(where(name="move", group="rosie.neck.left"), wait_s=WAIT_S)(0.2) == 0.2
    drv.deregister(arm)
    assert eventually(lambda: not planner.services(where(group="rosie.neck.left")))
    assert planner.estop("smoke").complete
    dash = join("dash")
    assert eventually(lambda: len(dash.addresses()) == 3)
    assert eventually(lambda: len(dash.services(where(name="clock"))) == 3)
    assert dash.services(where(group="rosie")) == []
    drv.close()
    assert eventually(lambda: len(planner.addresses()) == 2)
