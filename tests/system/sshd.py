"""An sshd of a test's own, with its own keys, on a free port of the loopback interface."""

import getpass
import os
import shutil
import socket
import subprocess
from collections.abc import Mapping
from pathlib import Path

from tests.support.waiting import wait_until
from trade.transport.endpoints import Endpoint, free_endpoint

_PLACES = os.pathsep.join((os.environ.get("PATH", os.defpath), "/usr/local/sbin", "/usr/sbin", "/sbin"))


def why_no_sshd() -> str:
    """What is missing; empty if nothing is."""
    missing = [name for name in ("sshd", "ssh", "ssh-keygen") if shutil.which(name, path=_PLACES) is None]
    return (
        f"no {' and no '.join(missing)} here; Debian: apt-get install openssh-server openssh-client" if missing else ""
    )


class Sshd:
    """Lets in who has the key ``user`` of its folder; its clients are configured by the file ``config``.

    Args:
        folder: for keys, logs and configuration.
        environment: of what is started through it.
    """

    def __init__(self, folder: Path, environment: Mapping[str, str]) -> None:
        self.folder = folder
        self.port = Endpoint.read(free_endpoint()).port
        self.known_hosts, self.config = folder / "known_hosts", folder / "config"
        for name in ("host", "user", "stranger"):
            subprocess.run(
                [_found("ssh-keygen"), "-q", "-t", "ed25519", "-N", "", "-C", name, "-f", folder / name], check=True
            )
        shutil.copy(folder / "user.pub", folder / "authorized_keys")
        self.know("host")
        self.write_config()
        set_env = " ".join(f'{name}="{value}"' for name, value in environment.items())
        (folder / "sshd_config").write_text(
            f"ListenAddress 127.0.0.1\nPort {self.port}\nHostKey {folder}/host\nPidFile none\n"
            f"AuthorizedKeysFile {folder}/authorized_keys\nStrictModes no\nUsePAM no\nPermitRootLogin yes\n"
            f"PasswordAuthentication no\nKbdInteractiveAuthentication no\nSetEnv {set_env}\n"
        )
        if os.getuid() == 0:
            Path("/run/sshd").mkdir(exist_ok=True)  # it wants one, as its service would make it
        with (folder / "log").open("w") as log:
            self.process = subprocess.Popen(
                [_found("sshd"), "-D", "-e", "-f", folder / "sshd_config"], stdin=subprocess.DEVNULL, stderr=log
            )
        wait_until(self._listens, "sshd listens")

    def _listens(self) -> bool:
        assert self.process.poll() is None, (self.folder / "log").read_text()
        with socket.socket() as probe:
            return probe.connect_ex(("127.0.0.1", self.port)) == 0

    def know(self, key: str) -> None:
        """Have its clients take that key for the one of this host."""
        kind, data, _ = (self.folder / f"{key}.pub").read_text().split()
        self.known_hosts.write_text(f"[127.0.0.1]:{self.port} {kind} {data}\n")

    def write_config(self, *, identity: str = "user", port: int | None = None) -> None:
        """What ``ssh -F`` reads: host ``robot`` is this one."""
        self.config.write_text(
            f"Host robot\n  HostName 127.0.0.1\n  Port {port or self.port}\n  User {getpass.getuser()}\n"
            f"  IdentityFile {self.folder}/{identity}\n  IdentitiesOnly yes\n  IdentityAgent none\n"
            f"  UserKnownHostsFile {self.known_hosts}\n  GlobalKnownHostsFile /dev/null\n"
        )

    def close(self) -> None:
        self.process.terminate()
        self.process.wait(20)


def _found(name: str) -> str:
    path = shutil.which(name, path=_PLACES)
    assert path is not None
    return path
