"""Who may speak and who may listen: key agreement, and sealing of messages and frames.

X25519 with fresh keys on both sides, mixed with the rig's key; AEAD for everything after the hello.
The construction, what it protects and what not: protocol/SPEC.md, section 6, and SECURITY.md.
"""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Protocol

from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PrivateKey, X25519PublicKey
from cryptography.hazmat.primitives.ciphers.aead import AESGCM, ChaCha20Poly1305
from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.hazmat.primitives.kdf.hkdf import HKDF

from rig_protocol.datagram import Buffer
from rig_protocol.errors import DataError
from rig_protocol.rig_key import RigKey

RandomBytes = Callable[[int], bytes]

TAG_SIZE = 16
PUBLIC_KEY_SIZE = 32
_KEY_SIZE = 32
_NONCE_SIZE = 12

_HELLO_PERSON = b"krhello2"
_SESSION_INFO = b"kinect-rig/2 session"
# One key, one message: hello and welcome keys are used for a single text each.
_ONLY_NONCE = bytes(_NONCE_SIZE)


class Cipher(IntEnum):
    """AEADs by wire id. An agent offers them in the order of their speed on its processor."""

    AES_256_GCM = 1
    CHACHA20_POLY1305 = 2


class Aead(Protocol):
    """What both ciphers of the `cryptography` library offer."""

    def encrypt(self, nonce: bytes, data: Buffer, associated_data: bytes | None) -> bytes:
        """Ciphertext and tag."""
        ...

    def decrypt(self, nonce: bytes, data: Buffer, associated_data: bytes | None) -> bytes:
        """The text, or InvalidTag."""
        ...


def make_aead(cipher: Cipher, key: bytes) -> Aead:
    """A cipher with its key."""
    return AESGCM(key) if cipher is Cipher.AES_256_GCM else ChaCha20Poly1305(key)


def counter_nonce(counter: int) -> bytes:
    """The nonce of the counter-th text under one key."""
    return counter.to_bytes(_NONCE_SIZE, "big")


@dataclass(frozen=True, slots=True)
class SessionKeys:
    """Secrets of one session, one for each use and direction."""

    welcome: bytes = field(repr=False)
    agent_control: bytes = field(repr=False)
    server_control: bytes = field(repr=False)
    frames: bytes = field(repr=False)


class EphemeralKey:
    """One side's key pair for one handshake; forgotten with it, which makes old traffic unreadable."""

    def __init__(self, random_bytes: RandomBytes) -> None:
        self._private = X25519PrivateKey.from_private_bytes(random_bytes(_KEY_SIZE))
        self.public = self._private.public_key().public_bytes_raw()

    def session_keys(self, peer_public: bytes, rig_key: RigKey, transcript: bytes) -> SessionKeys:
        """The secrets that both sides derive; DataError for a public key that no honest peer sends.

        `transcript`: what both have seen, so that nobody in between can have changed a bit of it.
        """
        try:
            shared = self._private.exchange(X25519PublicKey.from_public_bytes(peer_public))
        except ValueError as error:
            raise DataError("the public key is of low order") from error
        info = _SESSION_INFO + hashlib.sha256(transcript).digest()
        secrets = HKDF(SHA256(), 4 * _KEY_SIZE, salt=rig_key.secret, info=info).derive(shared)
        return SessionKeys(*(secrets[i : i + _KEY_SIZE] for i in range(0, len(secrets), _KEY_SIZE)))


def hello_aead(rig_key: RigKey, agent_public: bytes) -> Aead:
    """Seals one hello: a key for each agent's public key, from the rig's key alone."""
    key = hashlib.blake2s(agent_public, key=rig_key.secret, person=_HELLO_PERSON).digest()
    return ChaCha20Poly1305(key)


def seal_once(aead: Aead, text: bytes, associated: bytes) -> bytes:
    """Seal the only text that a key ever seals."""
    return aead.encrypt(_ONLY_NONCE, text, associated)


def open_once(aead: Aead, sealed: Buffer, associated: bytes) -> bytes | None:
    """The text of `seal_once`; None when it is not authentic."""
    try:
        return aead.decrypt(_ONLY_NONCE, sealed, associated)
    except InvalidTag:
        return None


class FrameSeal:
    """Seals and opens the frames of one session: the frame number is the nonce, each used once."""

    def __init__(self, cipher: Cipher, keys: SessionKeys) -> None:
        self._aead = make_aead(cipher, keys.frames)

    def seal(self, frame_number: int, unit: Buffer, place: bytes) -> bytes:
        """Ciphertext and tag, bound to their place on the wire."""
        return self._aead.encrypt(counter_nonce(frame_number), unit, place)

    def open(self, frame_number: int, sealed: Buffer, place: bytes) -> bytes | None:
        """The unit; None when a bit of it, or of its place, is not what the agent sealed."""
        try:
            return self._aead.decrypt(counter_nonce(frame_number), sealed, place)
        except InvalidTag:
            return None
