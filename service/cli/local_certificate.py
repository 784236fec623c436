"""A certificate of this machine's own, for HTTPS without a certificate authority. The only file with cryptography."""

from __future__ import annotations

import ipaddress
import os
import socket
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING

from service.errors import BackendMissing, StorageFailed

if TYPE_CHECKING:
    from cryptography import x509

_VALID = timedelta(days=397)
"""The longest that browsers accept."""
_RENEW = timedelta(days=30)
"""Before its end a certificate is replaced."""


@dataclass(frozen=True, slots=True)
class CertificateFiles:
    """PEM files."""

    certificate: Path
    key: Path


def local_addresses() -> list[str]:
    """Return the addresses by which other machines of the network may reach this one; none without a network."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe, suppress(OSError):
        # Nothing is sent: the system chooses the interface that leads elsewhere (192.0.2.1 is nobody's).
        probe.connect(("192.0.2.1", 9))
        return [probe.getsockname()[0]]
    return []


def local_certificate(folder: Path, names: Sequence[str]) -> CertificateFiles:
    """Return a self-signed certificate for these names and addresses, and this machine's own.

    It is kept in the folder, so that what a browser has accepted stays the same, and made anew if it lacks a name or
    ends soon. Raises BackendMissing without the package cryptography, StorageFailed.
    """
    wanted = sorted({*names, "localhost", "127.0.0.1", "::1", socket.gethostname()})
    files = CertificateFiles(folder / "certificate.pem", folder / "key.pem")
    try:
        if not _is_good(files, wanted):
            folder.mkdir(parents=True, exist_ok=True)
            _make(files, wanted)
    except ImportError as error:
        raise BackendMissing(
            "a local certificate needs the package cryptography.",
            where="https",
            hint="pip install 'splatfix[https]', or set SPLATFIX_CERTIFICATE and SPLATFIX_CERTIFICATE_KEY.",
        ) from error
    except OSError as error:
        raise StorageFailed(f"the certificate can't be kept: {error.strerror}.", where=str(folder)) from error
    return files


def fingerprint(certificate: Path) -> str:
    """Return the SHA-256 of a PEM file's first certificate, as browsers show it."""
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes

    return x509.load_pem_x509_certificate(certificate.read_bytes()).fingerprint(hashes.SHA256()).hex(":").upper()


def _is_good(files: CertificateFiles, wanted: Sequence[str]) -> bool:
    from cryptography import x509

    if not (files.certificate.exists() and files.key.exists()):
        return False
    try:
        found = x509.load_pem_x509_certificate(files.certificate.read_bytes())
        named = found.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except (ValueError, x509.ExtensionNotFound):
        # Damaged, or another program's: it is made anew.
        return False
    known = {*named.get_values_for_type(x509.DNSName), *map(str, named.get_values_for_type(x509.IPAddress))}
    return set(wanted) <= known and found.not_valid_after_utc > datetime.now(UTC) + _RENEW


def _make(files: CertificateFiles, names: Sequence[str]) -> None:
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

    key = ec.generate_private_key(ec.SECP256R1())
    owner = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, f"splatfix on {socket.gethostname()}"[:64])])
    now = datetime.now(UTC)
    made = (
        x509.CertificateBuilder()
        .subject_name(owner)
        .issuer_name(owner)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        # A phone's clock may be behind this machine's.
        .not_valid_before(now - timedelta(hours=1))
        .not_valid_after(now + _VALID)
        .add_extension(x509.SubjectAlternativeName([_general_name(name) for name in names]), critical=False)
        # It signs itself and nothing else: a device that trusts it trusts no other site because of it.
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(x509.ExtendedKeyUsage([ExtendedKeyUsageOID.SERVER_AUTH]), critical=False)
        .sign(key, hashes.SHA256())
    )
    secret = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    # Made anew: a file that is there already would keep its own, perhaps wider, permissions.
    files.key.unlink(missing_ok=True)
    with os.fdopen(os.open(files.key, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
        file.write(secret)
    files.certificate.write_bytes(made.public_bytes(serialization.Encoding.PEM))


def _general_name(name: str) -> x509.GeneralName:
    from cryptography import x509

    try:
        return x509.IPAddress(ipaddress.ip_address(name))
    except ValueError:
        return x509.DNSName(name)
