"""Who takes part in the attacks on a gateway, and what bare sessions say in them."""

import itertools
import time
from pathlib import Path
from typing import Any, Final

from msgspec import Raw

from tests.support.policies import policy_text
from tests.support.waiting import wait_until
from tests.system.sites import GATEWAY, Site
from trade.protocol.messages import PROTOCOL, Call, encode_message

POLICY: Final = policy_text(
    "arm=driver planner=operator porter=operator thief=operator dash=viewer chief=chief idle=",
    head='gateways = ["door"]\nrevoked_file = "pki/revoked.toml"\n',
    driver="register=rosie read=*",
    operator="read=* call=rosie,lab lock=rosie register=lab.planner",
    viewer="read=* call=lab register=lab.dash",
    chief="read=* administer=* instrument=* register=lab.chief",
)
LENIENT: Final = POLICY.replace('dash = ["viewer"]', 'dash = ["viewer", "operator", "driver", "chief"]')
ARM: Final = "rosie.arm"
numbers: Final = itertools.count(1)


class Attack:
    """The site, its containers, and what bare sessions say."""

    def __init__(self, site: Site) -> None:
        self.site = site
        lenient = site.folder / "lenient.toml"
        lenient.write_text(LENIENT)
        self.intruder = site.launched("right2", "intruder", script=Path(__file__).with_name("intruder.py"))
        self.arm = site.launched("left", "arm")
        self.planner, self.chief = (site.launched("right", who, reachable=True) for who in ("planner", "chief"))
        self.dash = site.launched("right2", "dash", policy=lenient, reachable=True)
        public = (self.planner, self.chief, self.dash)
        for member, side in ((self.arm, "private"), *((one, "public") for one in public)):
            member.tell("start", GATEWAY[side])
        for member in (self.arm, *public):
            member.heard()
        self.arm.ask("register_joint", ARM)
        self.arm.ask("tap")
        for member in public:
            member.ask("group", ARM, "arm")
        self.place: list[str] = self.planner.ask("place", "move", ARM)

    def moved(self) -> list[int]:
        """What the arm has done so far."""
        return self.arm.ask("moved", ARM)

    def revoke(self, who: str) -> None:
        """Once it is heeded."""
        if who not in self.site.papers.authority.revoked():
            self.folder(who)
            self.site.papers.authority.revoke(who)
            assert self.site.said()["reloaded"]

    def folder(self, who: str) -> Path:
        """With its certificate; a revoked one keeps what it had."""
        issued = self.site.papers.authority.folder / "issued" / who
        return issued if issued.exists() else self.site.papers.of(who)

    def open(self, identity: str, mode: str = "peer") -> str:
        """A session with that certificate, linked to the gateway, and as a peer to its neighbour; its name."""
        name = f"{identity}{next(numbers)}"
        self.intruder.ask("open", name, str(self.folder(identity)), GATEWAY["public"], mode)
        assert self.intruder.ask("linked", name, *([self.planner.ask("id")] if mode == "peer" else []))
        self.intruder.ask("listen", name, f"reply/*/{identity}/{name}/*")
        return name

    def key(self, who: str, *, kind: str = "call", system: bool = False) -> str:
        domain = ["trade", "system"] if system else self.place[3:]
        return "/".join([kind, who, *self.place[:3], *domain])

    def call(self, name: str, who: str, service: str, *args: object, session: str = "", **more: Any) -> str:
        """A message that is right in all that is not said."""
        behalf, channel = more.get("behalf"), more.get("channel", f"{name}/1")
        soon = time.monotonic_ns() + 20_000_000_000  # all hosts are this computer
        speaker, arguments = session or f"{who}/{name}/e1", Raw(encode_message(args))
        made = Call(PROTOCOL, next(numbers) << 30, service, channel, speaker, soon, (), arguments, behalf)
        return encode_message(made).hex()

    def say(self, name: str, key: str, payload: str) -> None:
        self.intruder.ask("put", name, key, payload)

    def passed(self, name: str, who: str, *keys: str, payload: str = "") -> list[str]:
        """Which of these keys the arm hears; what the session may always say comes behind them."""
        self.arm.ask("tapped")
        for key in keys:
            self.say(name, key, payload)
        heard: list[str] = []
        mark = f"stop/{who}/{self.place[0]}/x/mark{next(numbers)}/trade/system"

        def marked() -> bool:
            self.say(name, mark, "")
            heard.extend(self.arm.ask("tapped"))
            return mark in heard

        wait_until(marked, "a stop of its own passes")
        self.settle(name, who)
        heard.extend(self.arm.ask("tapped"))
        return sorted({key for key in heard if key in keys})

    def settle(self, name: str, who: str) -> None:
        """All calls that it has put before have been dealt with: one more, which every client may make, is answered."""
        answer = f"reply/{self.place[0]}/{who}/{name}/clock"
        self.say(name, self.key(who, system=True), self.call(name, who, "clock", channel=f"{name}/clock"))
        assert any(key == answer for key, _ in self.intruder.ask("heard", name, answer)), (
            "its clock is sent to any client"
        )

    def slipped(self, name: str, *keys: str) -> list[str]:
        """Which of these keys the arm hears of a session that may say nothing at all, not even that it has spoken."""
        self.arm.ask("tapped")
        for _ in range(5):
            for key in keys:
                self.say(name, key, "")
            self.planner.ask("call_group", ARM)
        return sorted(set(keys) & set(self.arm.ask("tapped")))
