"""How a phone comes to the page of a watch: an address, a certificate of its own, and a QR code."""

from __future__ import annotations

import secrets
import socket
import ssl
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from ipaddress import ip_address
from itertools import zip_longest
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from ..base.errors import MissingExtraError, UsageError
from .viewer_access import ip_of

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ec import EllipticCurvePrivateKey

VALID = timedelta(days=7)
"""How long a certificate holds: a field trip."""

CLOCK_SLACK = timedelta(days=1)
"""By how much the clock of a phone may be behind that of the machine."""

NOWHERE = "192.0.2.1"
"""An address for documentation (RFC 5737): the way to it is the way to any other machine."""

QUIET_ZONE = 4
"""Modules of light around a QR code, as its standard asks for."""

DARK_ON_LIGHT, AS_BEFORE = "\x1b[30;107m", "\x1b[0m"
"""What makes a terminal write black on white, whatever its own colours are."""


@dataclass(frozen=True, eq=False)
class Certificate:
    """A certificate that a server shows, with its key.

    Attributes
    ----------
    context
        Holds both; a server listens with it.
    pem
        The certificate alone, which is no secret.
    fingerprint
        SHA-256, as browsers show it: ``AB:12:…``.
    """

    context: ssl.SSLContext
    pem: str
    fingerprint: str


def own_certificate(host: str, folder: Path | None) -> Certificate:
    """Make a certificate for an address, signed by itself.

    Parameters
    ----------
    host
        An IP address of this machine.
    folder
        Where the key is written for as long as it is read back, encrypted, and for this user
        alone; None for the system's folder of temporary files.

    Raises
    ------
    MissingExtraError
        Where cryptography is not installed.
    UsageError
        Where `host` is no IP address.
    """
    try:
        from cryptography import x509
        from cryptography.hazmat.primitives import hashes, serialization
        from cryptography.hazmat.primitives.asymmetric import ec
        from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID
    except ImportError:
        raise MissingExtraError("live", "a page for a phone") from None

    address = ip_of(host)
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "retropole watch")])
    now = datetime.now(UTC)
    certificate = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - CLOCK_SLACK)
        .not_valid_after(now + VALID)
        .add_extension(x509.SubjectAlternativeName([x509.IPAddress(address)]), critical=False)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(x509.ExtendedKeyUsage([ExtendedKeyUsageOID.SERVER_AUTH]), critical=False)
        .sign(key, hashes.SHA256())
    )
    pem = certificate.public_bytes(serialization.Encoding.PEM)
    return Certificate(
        context=_context(pem, key, folder),
        pem=pem.decode(),
        fingerprint=certificate.fingerprint(hashes.SHA256()).hex(":").upper(),
    )


def _context(pem: bytes, key: EllipticCurvePrivateKey, folder: Path | None) -> ssl.SSLContext:
    """Load a certificate and its key, which Python does from a file alone."""
    from cryptography.hazmat.primitives import serialization

    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    # Should the file ever be left behind, nobody knows its password.
    password = secrets.token_bytes(32).hex().encode()
    encrypted = key.private_bytes(
        serialization.Encoding.PEM,
        serialization.PrivateFormat.PKCS8,
        serialization.BestAvailableEncryption(password),
    )
    with TemporaryDirectory(prefix="retropole-", dir=folder) as own:
        path = Path(own) / "key.pem"
        path.touch(mode=0o600)
        path.write_bytes(pem + encrypted)
        context.load_cert_chain(path, password=password)
    return context


def local_address() -> str:
    """Tell the address of this machine in the local network; nothing is sent.

    Raises
    ------
    UsageError
        Where it is in none.
    """
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asked:
        try:
            # A datagram socket sends nothing to connect: it only chooses the way.
            asked.connect((NOWHERE, 9))
        except OSError:
            raise UsageError("this machine is in no network that a phone could be in") from None
        address = str(asked.getsockname()[0])
    if ip_address(address).is_loopback or ip_address(address).is_unspecified:
        raise UsageError("this machine is in no network that a phone could be in")
    return address


def qr_code(url: str) -> str:
    """Draw an address for a terminal, dark on light: two modules a character.

    Raises
    ------
    MissingExtraError
        Where segno is not installed.
    """
    try:
        import segno
    except ImportError:
        raise MissingExtraError("live", "a QR code") from None

    code = segno.make(url, error="l", micro=False)
    rows = [[bool(module) for module in row] for row in code.matrix_iter(border=QUIET_ZONE)]
    light = [False] * len(rows[0])
    lines = (
        "".join(" ▄▀█"[2 * upper + lower] for upper, lower in zip(*pair, strict=True))
        for pair in zip_longest(rows[::2], rows[1::2], fillvalue=light)
    )
    return "\n".join(f"{DARK_ON_LIGHT}{line}{AS_BEFORE}" for line in lines)
