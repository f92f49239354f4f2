"""A certificate authority in a folder: issues, renews and revokes certificates of containers and gateways.

========================  ==========================================================================================
``ca.pem``, ``ca.key``    the authority; its key can issue any identity
``names/NAME``            the permanent purpose of a name: ``container`` or ``gateway``
``issued/NAME/``          ``ca.pem``, ``cert.pem`` and ``key.pem``: what a container is started with (``TRADE_TLS``)
``revoked/NAME``          marks a name as permanently revoked
``revoked.toml``          ``revoked``, all of them: the names that a policy has to refuse
========================  ==========================================================================================
"""

import contextlib
import ipaddress
import os
import secrets
import stat
from collections.abc import Iterable, Sequence
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import Final, Literal, cast

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID
from msgspec import Struct

from trade.atomic_files import claim, replace
from trade.errors import ConfigurationError
from trade.protocol.keys import is_chunk
from trade.text_files import as_before, read_text
from trade.toml_files import read_toml_text

Purpose = Literal["container", "gateway"]

_LASTS: Final = timedelta(days=7)
"""Links do not check revocation: a stolen key works until its certificate expires, so this is short. But a container
listens with the certificate that it started with until it is restarted, so this is longer than a shift."""
_AUTHORITY_LASTS: Final = timedelta(days=3650)
_CLOCKS_DIFFER: Final = timedelta(minutes=5)
_LONGEST_NAME: Final = 64
"""The longest common name in X.509."""
_HERE: Final = ("localhost", "127.0.0.1", "::1")

_Host = x509.DNSName | x509.IPAddress


class NoAuthority(ConfigurationError):
    """The folder has no usable authority, or has one already."""


class NameTaken(ConfigurationError):
    """A gateway's name is requested for a container, or the other way round."""


class NameRevoked(ConfigurationError):
    """The name was revoked."""


class Issued(Struct, frozen=True):
    """A name, with its latest certificate."""

    name: str
    purpose: Purpose
    until: datetime | None
    """None: its files are no longer in the folder."""
    hosts: tuple[str, ...]
    """Its host names and addresses besides localhost."""
    revoked: bool
    folder: Path


class Authority:
    """The certificate authority of a folder.

    Raises:
        NoAuthority: the folder has no usable authority.
    """

    def __init__(self, folder: Path) -> None:
        self.folder: Final = folder.absolute()
        self._certificate, self._key = self._read()

    @classmethod
    def create(cls, folder: Path) -> "Authority":
        """Creates an authority. Raises NoAuthority if there is one, whose certificates would become worthless."""
        key = ec.generate_private_key(ec.SECP256R1())
        name = _named(f"TRADE authority {secrets.token_hex(4)}")
        now = datetime.now(timezone.utc)
        certificate = (
            x509.CertificateBuilder(name, name, key.public_key(), x509.random_serial_number())
            .not_valid_before(now - _CLOCKS_DIFFER)
            .not_valid_after(now + _AUTHORITY_LASTS)
            .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
            .add_extension(_usage(certificates=True), critical=True)
            .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
            .sign(key, hashes.SHA256())
        )
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        try:
            claim(folder / "ca.key", _key_text(key))
        except FileExistsError:
            problem = "there is an authority already; use it, or name another folder"
            raise NoAuthority(where=str(folder), problem=problem) from None
        replace(folder / "ca.pem", certificate.public_bytes(serialization.Encoding.PEM), 0o644)
        made = cls(folder)
        made._list_revoked()  # a policy that names the list must find one
        return made

    def issue(
        self,
        name: str,
        *,
        purpose: Purpose | None = None,
        hosts: Sequence[str] = (),
        addresses: Sequence[str] = (),
        lasts: timedelta | None = None,
        new_key: bool = False,
    ) -> Issued:
        """Issues a certificate for a name, or renews it.

        A renewed certificate keeps the key and the hosts, and replaces the old one atomically.

        Args:
            name: the identity.
            purpose: the purpose; None: as before, or container for a new name.
            hosts: host names besides localhost.
            addresses: addresses besides those of the loopback interface.
            lasts: the validity, by default a week; limited by the authority's own.
            new_key: make a new key, and drop earlier hosts and addresses.

        Raises:
            NameTaken: the name has another purpose.
            NameRevoked: the name was revoked.
            NoAuthority: the authority itself has expired.
            ConfigurationError: a name, host or address is invalid, or the key is missing.
        """
        _check_name(name)
        wanted = [*_addresses(addresses), *map(_dns_name, hosts)]
        if name in self.revoked():
            problem = f"was revoked, and is not issued again; choose another name ({self._revoked_file} has the list)"
            raise NameRevoked(where=name, problem=problem)
        until = self._end(lasts or _LASTS)
        known = self._take(name, purpose)
        folder = self.folder / "issued" / name
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        renewed = known and not new_key
        key = _read_key(folder / "key.pem", name) if renewed else ec.generate_private_key(ec.SECP256R1())
        had = _hosts_so_far(folder / "cert.pem") if renewed else [*_addresses(_HERE[1:]), x509.DNSName(_HERE[0])]
        certificate = self._signed(name, key, list(dict.fromkeys([*had, *wanted])), until)
        if not renewed:
            replace(folder / "key.pem", _key_text(key), 0o600)
        replace(folder / "ca.pem", self._certificate.public_bytes(serialization.Encoding.PEM), 0o644)
        replace(folder / "cert.pem", certificate.public_bytes(serialization.Encoding.PEM), 0o644)
        return self._known(name)

    def revoke(self, name: str) -> Issued:
        """Revokes a name permanently: it is not issued again, and policies with the list refuse it.

        Raises:
            ConfigurationError: the name was never issued.
        """
        if name not in self._names():
            problem = f"was never issued; there is {', '.join(self._names()) or 'no identity'}"
            raise ConfigurationError(where=name, problem=problem)
        self._listed()  # a damaged list must be repaired first
        marks = self.folder / "revoked"
        marks.mkdir(mode=0o700, exist_ok=True)
        with contextlib.suppress(FileExistsError):
            claim(marks / name, b"")
        self._list_revoked()
        return self._known(name)

    def _list_revoked(self) -> None:
        """Writes the list until it is complete: a concurrent revocation marks its name before it writes its list."""
        while (names := self.revoked()) != self._listed():
            listed = ", ".join(f'"{name}"' for name in sorted(names))
            text = f"# Written by trade pki: identities that policies refuse.\nrevoked = [{listed}]\n"
            before = self._revoked_file.read_bytes() if self._revoked_file.exists() else b""
            replace(self._revoked_file, as_before(before, text), 0o644)

    def issued(self) -> list[Issued]:
        """Returns all names that were ever issued, sorted."""
        return [self._known(name) for name in self._names()]

    def revoked(self) -> frozenset[str]:
        """Returns the revoked names. Raises ConfigurationError if the list is damaged."""
        marked = frozenset(path.name for path in (self.folder / "revoked").glob("[!.]*"))
        return marked | (self._listed() or frozenset())

    def _listed(self) -> frozenset[str] | None:
        """Returns the names in the list for policies; None if there is no list."""
        try:
            listed = read_toml_text(read_text(self._revoked_file))["revoked"]
        except FileNotFoundError:
            return None
        except (ValueError, KeyError):
            listed = None
        names = cast("list[object]", listed) if isinstance(listed, list) else [None]
        if not all(isinstance(name, str) and is_chunk(name) for name in names):
            problem = 'must be like revoked = ["old-arm"]; correct it first, so that no revoked name is lost'
            raise ConfigurationError(where=str(self._revoked_file), problem=problem)
        return frozenset(map(str, names))

    @property
    def _revoked_file(self) -> Path:
        return self.folder / "revoked.toml"

    def _read(self) -> tuple[x509.Certificate, ec.EllipticCurvePrivateKey]:
        path = self.folder / "ca.key"
        try:
            certificate = _load(self.folder / "ca.pem")
            key = serialization.load_pem_private_key(path.read_bytes(), None)
        except FileNotFoundError:
            problem = f"has no authority; create one with trade pki init {self.folder}, or name its folder with --ca"
            raise NoAuthority(where=str(self.folder), problem=problem) from None
        except (OSError, ValueError, TypeError) as bad:
            raise NoAuthority(where=str(self.folder), problem=f"ca.pem or ca.key cannot be read: {bad}") from None
        if os.name == "posix" and stat.S_IMODE(path.stat().st_mode) & 0o077:
            problem = (
                f"others can read it, and issue any identity; chmod 600 {path}, and create a new authority if they did"
            )
            raise NoAuthority(where=str(path), problem=problem)
        if not isinstance(key, ec.EllipticCurvePrivateKey) or key.public_key() != certificate.public_key():
            raise NoAuthority(where=str(path), problem="is not the key of ca.pem beside it; take both from one backup")
        return certificate, key

    def _names(self) -> list[str]:
        return sorted(path.name for path in (self.folder / "names").glob("[!.]*"))

    def _purpose(self, name: str) -> Purpose:
        """Returns the purpose of a name; a damaged mark counts as a gateway's."""
        mark = (self.folder / "names" / name).read_text(encoding="utf-8").strip()
        return "container" if mark == "container" else "gateway"

    def _take(self, name: str, purpose: Purpose | None) -> bool:
        """Marks a name as issued; returns whether it was before. Raises NameTaken."""
        marks = self.folder / "names"
        marks.mkdir(mode=0o700, exist_ok=True)
        with contextlib.suppress(FileExistsError):
            claim(marks / name, f"{purpose or 'container'}\n".encode())
            return False
        given = self._purpose(name)
        if purpose not in (None, given):
            problem = f"is permanently the name of a {given}, not of a {purpose}; choose another name"
            raise NameTaken(where=name, problem=problem)
        return True

    def _known(self, name: str) -> Issued:
        folder = self.folder / "issued" / name
        purpose, revoked = self._purpose(name), name in self.revoked()
        try:
            last = _load(folder / "cert.pem")
        except (OSError, ValueError):
            return Issued(name, purpose, None, (), revoked, folder)
        hosts = tuple(text for text in (str(host.value) for host in _hosts(last)) if text not in _HERE)
        return Issued(name, purpose, last.not_valid_after_utc, hosts, revoked, folder)

    def _end(self, lasts: timedelta) -> datetime:
        now, end = datetime.now(timezone.utc), self._certificate.not_valid_after_utc
        if now >= end:
            problem = f"has expired ({end:%Y-%m-%d}); create a new one in another folder, and issue all names there"
            raise NoAuthority(where=str(self.folder), problem=problem)
        return min(now + lasts, end)

    def _signed(
        self, name: str, key: ec.EllipticCurvePrivateKey, hosts: list[_Host], until: datetime
    ) -> x509.Certificate:
        public = key.public_key()
        issuer = x509.AuthorityKeyIdentifier.from_issuer_public_key(self._key.public_key())
        return (
            x509.CertificateBuilder(self._certificate.subject, _named(name), public, x509.random_serial_number())
            .not_valid_before(datetime.now(timezone.utc) - _CLOCKS_DIFFER)
            .not_valid_after(until)
            .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
            .add_extension(_usage(certificates=False), critical=True)
            .add_extension(
                x509.ExtendedKeyUsage([ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH]),
                critical=False,
            )
            .add_extension(x509.SubjectAlternativeName(hosts), critical=False)
            .add_extension(issuer, critical=False)
            .sign(self._key, hashes.SHA256())
        )


def _named(name: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])


def _usage(*, certificates: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not certificates,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        key_cert_sign=certificates,
        crl_sign=False,
        encipher_only=False,
        decipher_only=False,
    )


def _check_name(name: str) -> None:
    if not is_chunk(name) or name.startswith(".") or len(name) > _LONGEST_NAME:
        problem = f"is no identity; use letters, digits, _ - and . (at most {_LONGEST_NAME}, not a . first)"
        raise ConfigurationError(where=repr(name), problem=problem)


def _addresses(texts: Iterable[str]) -> list[x509.IPAddress]:
    try:
        return [x509.IPAddress(ipaddress.ip_address(text)) for text in texts]
    except ValueError as bad:
        raise ConfigurationError(where="--address", problem=f"{bad}; names go with --host") from None


def _dns_name(text: str) -> x509.DNSName:
    if _is_address(text):
        raise ConfigurationError(where="--host", problem=f"{text} is an address; say --address {text}")
    try:
        if not text or any(sign in text for sign in " /:"):
            raise ValueError(text)
        return x509.DNSName(text)
    except ValueError:
        raise ConfigurationError(where="--host", problem=f"{text!r} is no name of a host") from None


def _is_address(text: str) -> bool:
    try:
        ipaddress.ip_address(text)
    except ValueError:
        return False
    return True


def _load(path: Path) -> x509.Certificate:
    return x509.load_pem_x509_certificate(path.read_bytes())


def _hosts(certificate: x509.Certificate) -> list[_Host]:
    return cast("list[_Host]", list(certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value))


def _hosts_so_far(path: Path) -> list[_Host]:
    """Returns the hosts of the latest certificate."""
    try:
        return _hosts(_load(path))
    except (OSError, ValueError):
        problem = "cannot be read, so its hosts are unknown; --force makes a new one"
        raise ConfigurationError(where=str(path), problem=problem) from None


def _read_key(path: Path, name: str) -> ec.EllipticCurvePrivateKey:
    try:
        key = serialization.load_pem_private_key(path.read_bytes(), None)
    except (OSError, ValueError, TypeError):
        key = None
    if not isinstance(key, ec.EllipticCurvePrivateKey):
        problem = f"is missing or damaged; restore it, or give {name} another one with --force"
        raise ConfigurationError(where=str(path), problem=problem)
    return key


def _key_text(key: ec.EllipticCurvePrivateKey) -> bytes:
    return key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
