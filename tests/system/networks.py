"""Hosts as network namespaces, the networks between them, and containers there that a test controls."""

import contextlib
import json
import os
import queue
import secrets
import shutil
import subprocess
import sys
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

PATIENCE_S = 60.0
MEMBER = Path(__file__).with_name("member.py")


def ip(*words: str) -> str:
    """Runs ``ip WORDS``; raises CalledProcessError."""
    return subprocess.run(["ip", *words], capture_output=True, text=True, check=True, timeout=20).stdout


def why_not() -> str:
    """Why there can be no namespaces here; empty if there can."""
    if shutil.which("ip") is None:
        return "there is no `ip` (Debian: iproute2)"
    probe = f"trade-{secrets.token_hex(3)}"
    try:
        ip("netns", "add", probe)
        ip("netns", "exec", probe, "unshare", "--uts", "true")
        ip("netns", "del", probe)
    except subprocess.CalledProcessError as refused:
        return f"network namespaces need rights this user has not: {refused.stderr.strip()}"
    return ""


class Member:
    """``member.py``, or another script that is controlled by lines, in one of the namespaces.

    With certificates if ``tls`` is its folder, else with a password; ``system`` if it is not the test's own;
    ``through`` another script, with its words, that runs this one.
    """

    def __init__(
        self,
        namespace: str,
        name: str,
        address: str,
        runtime: Path,
        bridge: str = "",
        tls: Path | None = None,
        policy: Path | None = None,
        script: Path = MEMBER,
        system: str = "",
        through: Sequence[str] = (),
    ) -> None:
        # With a host name of its own: the namespace's.
        command = ["ip", "netns", "exec", namespace, "unshare", "--uts", sys.executable, *through, str(script)]
        # Each namespace is a host of its own: no folder in common.
        lax = {} if policy is not None else {"TRADE_INSECURE_LAN": "1"}
        entry = {"TRADE_CREDENTIALS": "lab:secret"} if tls is None else {"TRADE_TLS": str(tls)}
        environment = {
            **os.environ,
            "TRADE_RUNTIME_DIR": str(runtime / namespace),
            "TRADE_STATE_DIR": str(runtime / namespace / "state"),
            "TRADE_BRIDGE": bridge,
            **lax,
            **entry,
            **({} if policy is None else {"TRADE_POLICY": str(policy)}),
            **({"TRADE_SYSTEM": system} if system else {}),
        }
        self._process = subprocess.Popen(
            [*command, namespace, name, address],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            env=environment,
        )
        self._said: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._listener = threading.Thread(target=self._listen, name=f"listen-{name}", daemon=True)
        self._listener.start()

    @property
    def pid(self) -> int:
        """Of its process."""
        return self._process.pid

    def tell(self, *words: str) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(" ".join(words) + "\n")
        self._process.stdin.flush()

    def heard(self) -> Any:
        said = self.says()
        assert "error" not in said, said["error"]
        return said["answer"]

    def says(self) -> dict[str, Any]:
        """What it says next; a member that says nothing fails the test instead of holding it up."""
        try:
            line = self._said.get(timeout=PATIENCE_S)
        except queue.Empty:
            raise AssertionError(f"a member said nothing for {PATIENCE_S} s") from None
        assert line, "the member has ended"
        return json.loads(line)

    def _listen(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            self._said.put(line)
        self._said.put("")

    def ask(self, *words: str) -> Any:
        self.tell(*words)
        return self.heard()

    def refused(self, *words: str) -> str:
        """The error that it gets."""
        self.tell(*words)
        said = self.says()
        assert "error" in said, said
        return said["error"]

    def kill(self) -> None:
        self._process.kill()
        self._process.wait(20)

    def close(self) -> None:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        with contextlib.suppress(OSError):
            self._process.stdin.close()
        try:
            self._process.wait(20)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._listener.join(20)
        self._process.stdout.close()


class Networks:
    """Hosts, by name, and networks that several of them have a foot in; nothing is routed between networks."""

    def __init__(self) -> None:
        self._mark = secrets.token_hex(3)
        self._hosts: list[str] = []

    def host(self, name: str) -> str:
        """The namespace of a host; made if there is none of that name yet."""
        namespace = f"trade-{self._mark}-{name}"
        if namespace not in self._hosts:
            ip("netns", "add", namespace)
            self._hosts.append(namespace)
            ip("-n", namespace, "link", "set", "lo", "up")
        return namespace

    def lay(self, network: str, **addresses: str) -> None:
        """A network: by host, its address there. On each host the interface is named after the network."""
        switch = self.host(f"{network}-switch")
        ip("-n", switch, "link", "add", "switch", "type", "bridge")
        ip("-n", switch, "link", "set", "switch", "up")
        for name, address in addresses.items():
            host = self.host(name)
            ip("-n", switch, "link", "add", name, "type", "veth", "peer", "name", network, "netns", host)
            ip("-n", switch, "link", "set", name, "master", "switch", "up")
            ip("-n", host, "addr", "add", f"{address}/24", "dev", network)
            ip("-n", host, "link", "set", network, "up")
        for name in addresses:
            _wait_until_up(self.host(name), network)

    def close(self) -> None:
        for namespace in self._hosts:
            with contextlib.suppress(subprocess.CalledProcessError):
                ip("netns", "del", namespace)


def _wait_until_up(namespace: str, interface: str) -> None:
    """The transport looks at the interfaces once a process: who starts on a dead one never scouts there."""
    for _ in range(1000):
        if "state UP" in ip("-n", namespace, "link", "show", interface):
            return
        threading.Event().wait(0.01)
    raise TimeoutError(f"{interface} of {namespace} does not come up")
