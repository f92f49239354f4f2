"""Certificates: they prove a container's identity on every link; also their settings for the transport.

A handshake with ourselves, in memory, checks that the files of a folder fit together before anything opens: the
transport does not report what is wrong with them.
"""

import codecs
import contextlib
import hashlib
import ipaddress
import os
import ssl
import stat
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Any, Final, cast

from trade.errors import ConfigurationError
from trade.protocol.keys import is_chunk

_CA: Final = "ca.pem"
_CERTIFICATE: Final = "cert.pem"
_KEY: Final = "key.pem"
_MARKS: Final = {_CA: "BEGIN CERTIFICATE", _CERTIFICATE: "BEGIN CERTIFICATE", _KEY: "PRIVATE KEY"}
_OTHERS: Final = 0o007
_FLIGHTS: Final = 4
"""More flights than a handshake has in either direction."""
_REFUSALS: Final = {
    9: "is not valid yet. Is the clock of this host right?",
    10: "has expired, or its authority has; renew it: trade pki issue NAME",
    26: "may not be used for both ends of a link; issue it with trade pki issue NAME",
}
"""By OpenSSL's X509_V_ERR_CERT_NOT_YET_VALID, X509_V_ERR_CERT_HAS_EXPIRED and X509_V_ERR_INVALID_PURPOSE."""
_ISSUE: Final = "trade pki issue NAME makes a folder that has all three"


@dataclass(frozen=True, slots=True)
class Certificate:
    """The contents of a folder with ``ca.pem``, ``cert.pem`` and ``key.pem``."""

    folder: Path
    identity: str
    """The common name of the certificate."""
    hosts: frozenset[str]
    """Names and addresses under which other containers may dial this one."""
    until: datetime

    @classmethod
    def read(cls, folder: Path) -> "Certificate":
        """Raises ConfigurationError: a file is missing, or peers would reject the certificate; names file and cause."""
        for name, mark in _MARKS.items():
            _check_file(folder / name, mark)
        fields = _proven(folder)
        names = [text for part in fields["subject"] for kind, text in part if kind == "commonName"]
        if len(names) != 1 or not is_chunk(names[0]):
            problem = f"has the common name {', '.join(names) or '(none)'}, which is no identity; {_ISSUE}"
            raise ConfigurationError(where=str(folder / _CERTIFICATE), problem=problem)
        until = datetime.fromtimestamp(ssl.cert_time_to_seconds(fields["notAfter"]), timezone.utc)
        hosts = frozenset(_plain(host) for _, host in fields.get("subjectAltName", ()))
        return cls(folder, names[0], hosts, until)

    def check_is_for(self, host: str) -> None:
        """Raises ConfigurationError: a peer that dials this host would reject the certificate."""
        if _plain(host) not in self.hosts:
            problem = (
                f"is for {', '.join(sorted(self.hosts)) or 'no host'}, not for {host}, so no peer would link to it "
                f"there; add it: trade pki issue {self.identity} --address {host} (or --host, for a name)"
            )
            raise ConfigurationError(where=str(self.folder / _CERTIFICATE), problem=problem)


def transport_settings(certificate: Certificate) -> dict[str, Any]:
    """The certificate in zenoh's settings: both ends present certificates, and a link ends when one of them expires."""
    key, shown = (str(certificate.folder / name) for name in (_KEY, _CERTIFICATE))
    return {
        "root_ca_certificate": str(certificate.folder / _CA),
        "enable_mtls": True,
        "listen_private_key": key,
        "listen_certificate": shown,
        "connect_private_key": key,
        "connect_certificate": shown,
        "verify_name_on_connect": True,
        "close_link_on_expiration": True,
    }


def line_context(certificate: Certificate, *, server: bool) -> ssl.SSLContext:
    """The TLS context of the stop line: both ends present certificates, and the client checks the server's name."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER if server else ssl.PROTOCOL_TLS_CLIENT)
    context.minimum_version = ssl.TLSVersion.TLSv1_3
    context.verify_mode = ssl.CERT_REQUIRED
    context.load_verify_locations(certificate.folder / _CA)
    context.load_cert_chain(certificate.folder / _CERTIFICATE, certificate.folder / _KEY)
    return context


def common_name(sock: ssl.SSLSocket) -> str:
    """The identity at the other end, from its verified certificate; empty if that contains no valid identity."""
    fields = cast("dict[str, Any]", sock.getpeercert() or {})
    names = [text for part in fields.get("subject", ()) for kind, text in part if kind == "commonName"]
    return names[0] if len(names) == 1 and is_chunk(names[0]) else ""


def authority(settings: dict[str, Any]) -> bytes:
    """A secret common to all containers of one authority, which never travels over the network."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.load_verify_locations(settings["root_ca_certificate"])
    return hashlib.sha256(b"".join(sorted(context.get_ca_certs(binary_form=True)))).digest()


def _plain(host: str) -> str:
    """An address in its canonical form, or a name."""
    try:
        return str(ipaddress.ip_address(host.strip("[]")))
    except ValueError:
        return host.lower()


def _check_file(path: Path, mark: str) -> None:
    try:
        data = path.read_bytes()
        mode = path.stat().st_mode
    except PermissionError as bad:
        raise ConfigurationError(where=str(path), problem=f"cannot be read ({bad.strerror}): {_closed(path)}") from None
    except OSError as bad:
        problem = f"cannot be read ({bad.strerror}); {_ISSUE}"
        raise ConfigurationError(where=str(path), problem=problem) from None
    if data.startswith((codecs.BOM_UTF8, codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        problem = "begins with a byte-order mark, which TLS does not read; save it as ASCII, or as UTF-8 without it"
        raise ConfigurationError(where=str(path), problem=problem)
    text = data.decode("ascii", errors="replace")
    if mark not in text or "ENCRYPTED" in text:
        kind = "unencrypted private key" if path.name == _KEY else "certificate"
        raise ConfigurationError(where=str(path), problem=f"is no {kind} in PEM form; {_ISSUE}")
    if path.name == _KEY and os.name == "posix" and stat.S_IMODE(mode) & _OTHERS:
        raise ConfigurationError(where=str(path), problem=f"others can read it: chmod 600 {path}")


def _closed(path: Path) -> str:
    """Why this user cannot read a file, and what to do."""
    folder = next((above for above in reversed(path.absolute().parents) if not os.access(above, os.X_OK)), None)
    what, mode = (path, "0640") if folder is None else (folder, "0750")
    try:
        whose = f"is of {what.owner()}:{what.group()}, with mode {stat.S_IMODE(what.stat().st_mode):04o}"
    except (OSError, KeyError, NotImplementedError):
        whose = "is closed to this user"
    remedy = f"sudo chgrp GROUP {what} && sudo chmod {mode} {what}"
    return f"{what} {whose}; give it to a group that this user is of: {remedy}"


def _proven(folder: Path) -> dict[str, Any]:
    """The fields of the certificate, if both ends of a link accept it."""
    server, client = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER), ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    client.check_hostname = False
    try:
        for context in (client, server):
            context.verify_mode = ssl.CERT_REQUIRED
            context.load_verify_locations(folder / _CA)
            context.load_cert_chain(folder / _CERTIFICATE, folder / _KEY)
        return _shaken_hands(client, server)
    except ssl.SSLCertVerificationError as refused:
        raise ConfigurationError(where=str(folder / _CERTIFICATE), problem=_refusal(refused)) from None
    except ssl.SSLError as bad:
        if bad.reason in ("KEY_VALUES_MISMATCH", "KEY_TYPE_MISMATCH"):
            problem = f"is not the key of {_CERTIFICATE} beside it; take both from one trade pki issue"
            raise ConfigurationError(where=str(folder / _KEY), problem=problem) from None
        problem = f"one of {', '.join(_MARKS)} is damaged ({bad.reason}); {_ISSUE}"
        raise ConfigurationError(where=str(folder), problem=problem) from None


def _shaken_hands(client: ssl.SSLContext, server: ssl.SSLContext) -> dict[str, Any]:
    to_server, to_client = ssl.MemoryBIO(), ssl.MemoryBIO()
    calling = client.wrap_bio(to_client, to_server)
    called = server.wrap_bio(to_server, to_client, server_side=True)
    for end in (calling, called) * _FLIGHTS:
        with contextlib.suppress(ssl.SSLWantReadError):
            end.do_handshake()
    return cast("dict[str, Any]", called.getpeercert())


def _refusal(refused: ssl.SSLCertVerificationError) -> str:
    foreign = f"was not issued by the authority in {_CA} beside it ({refused.verify_message}); {_ISSUE}"
    return _REFUSALS.get(refused.verify_code, foreign)
