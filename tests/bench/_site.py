"""Three networks in a row with a gateway between each two, as deployed: certificates, a policy, a host a namespace.

    robot, aside -- near -- door -- far -- office, lobby, gate -- beyond -- home

Loopback addresses are no replacement: all of them are on one interface, and networks are distinguished by interfaces.
"""

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Final

from tests.bench._report import print_skipped
from tests.support.certificates import Papers
from tests.support.policies import policy_text
from tests.system.networks import Networks, why_not

ADDRESSES: Final = {
    "near": {"door": "10.232.1.1", "robot": "10.232.1.2", "aside": "10.232.1.3"},
    "far": {"door": "10.232.2.1", "office": "10.232.2.2", "lobby": "10.232.2.3", "gate": "10.232.2.4"},
    "beyond": {"gate": "10.232.3.1", "home": "10.232.3.2"},
}
"""By network and host."""
GATEWAYS: Final = ("door", "gate")
SECURE, PLAIN = 7450, 7451
"""Ports of the gateways: with certificates and a policy, and with a password alone."""
SYSTEM: Final = {SECURE: "bench-secure", PLAIN: "bench-plain"}
_PATIENCE_S = 20.0

_POLICY = policy_text(
    "robot=driver planner=operator mallory=operator",
    head='gateways = ["door", "gate"]\n',
    driver="register=bench,rosie",
    operator="read=* call=bench lock=bench",
)
_ENTRY = {
    SECURE: 'tls = "pki/issued/{name}"\npolicy = "policy.toml"',
    PLAIN: 'credentials = "bench:secret"\ninsecure_lan = true',
}
_NETWORK = """
[network.{network}]
interface = "{network}"
listen = ["{protocol}/{address}:{port}"]
"""


class Site:
    """The networks, the files of who is on them, and the gateways that run."""

    def __init__(self, folder: Path, networks: Networks, stack: ExitStack) -> None:
        self.folder = folder
        self._networks = networks
        self._stack = stack
        self._processes: dict[int, subprocess.Popen[bytes]] = {}
        for network, hosts in ADDRESSES.items():
            networks.lay(network, **hosts)
        papers = Papers(folder / "pki")
        for gateway in GATEWAYS:
            own = [hosts[gateway] for hosts in ADDRESSES.values() if gateway in hosts]
            papers.of(gateway, addresses=own, purpose="gateway")
        papers.of("robot", addresses=[ADDRESSES["near"]["robot"]])
        for name in ("planner", "mallory"):
            papers.of(name)
        self.policy.write_text(_POLICY)

    @property
    def policy(self) -> Path:
        return self.folder / "policy.toml"

    def papers(self, identity: str) -> Path:
        """The folder of a certificate."""
        return self.folder / "pki" / "issued" / identity

    def host(self, name: str) -> str:
        """Its namespace."""
        return self._networks.host(name)

    def begin_gateway(self, name: str, port: int) -> int:
        """Start ``trade gateway`` on its host, which dials the one before it; returns its process id when it is up."""
        protocol = "tls" if port == SECURE else "tcp"
        file = self.folder / f"{name}-{port}.toml"
        own = {network: hosts[name] for network, hosts in ADDRESSES.items() if name in hosts}
        head = [f'system = "{SYSTEM[port]}"', f'name = "{name}"', _ENTRY[port].format(name=name)]
        if name == "gate":  # it comes as a guest into the network that the door listens on
            head.append(f'connect = ["{protocol}/{ADDRESSES["far"]["door"]}:{port}"]')
            del own["far"]
        networks = (
            _NETWORK.format(network=network, protocol=protocol, address=address, port=port)
            for network, address in own.items()
        )
        file.write_text("\n".join(head) + "".join(networks))
        return self.begin(name, "-m", "trade_gateway", "gateway", str(file), "--json", runtime=file.stem)

    def begin(self, host: str, *words: str, runtime: str, **environment: str) -> int:
        """Start a Python program on a host; returns its process id when it has said its first line."""
        command = ["ip", "netns", "exec", self.host(host), sys.executable, *words]
        places = {"TRADE_RUNTIME_DIR": str(self.folder / runtime), "TRADE_STATE_DIR": str(self.folder / runtime)}
        process = subprocess.Popen(command, stdout=subprocess.PIPE, env={**os.environ, **places, **environment})
        self._processes[process.pid] = process
        self._stack.callback(_end, process)
        assert process.stdout is not None
        if not json.loads(process.stdout.readline() or b"null"):
            raise RuntimeError(f"{' '.join(words)} did not begin; see above")
        return process.pid  # `ip netns exec` becomes the program

    def end(self, pid: int) -> None:
        """What was begun and is not to run beside what comes next."""
        _end(self._processes[pid])


def _end(process: "subprocess.Popen[bytes]") -> None:
    process.terminate()
    try:
        process.wait(_PATIENCE_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
    assert process.stdout is not None
    process.stdout.close()


@contextmanager
def site() -> Iterator[Site | None]:
    """Lay the networks; all is gone at the end. None, and the reason is said, where that cannot be."""
    if reason := why_not():
        print_skipped("gateway", reason)
        yield None
        return
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        networks = Networks()
        stack.callback(networks.close)
        yield Site(Path(folder), networks, stack)
