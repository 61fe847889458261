"""The building blocks of trust: ciphers, seals of frames, keys."""

import pytest

from rig_protocol.security import (
    TAG_SIZE,
    Cipher,
    counter_nonce,
    hello_aead,
    make_aead,
    open_once,
    seal_once,
)
from support.wire import KEY, make_seal, random_bytes

# RFC 8439, section 2.8.2, and test case 16 of the GCM specification (McGrew and Viega): pinned by others.
RFC_KEY = bytes(range(0x80, 0xA0))
RFC_TEXT = (
    b"Ladies and Gentlemen of the class of '99: If I could offer you only one tip for the future, "
    b"sunscreen would be it."
)
GCM_KEY = bytes.fromhex("feffe9928665731c6d6a8f9467308308" * 2)
GCM_TEXT = bytes.fromhex(
    "d9313225f88406e5a55909c5aff5269a86a7a9531534f7da2e4c303d8a318a72"
    "1c3c0c95956809532fcf0e2449a6b525b16aedf5aa0de657ba637b39"
)


def test_the_ciphers_are_those_of_their_standards() -> None:
    sealed = make_aead(Cipher.CHACHA20_POLY1305, RFC_KEY).encrypt(
        bytes.fromhex("070000004041424344454647"), RFC_TEXT, bytes.fromhex("50515253c0c1c2c3c4c5c6c7")
    )
    assert sealed[-TAG_SIZE:].hex() == "1ae10b594f09e26a7e902ecbd0600691"
    sealed = make_aead(Cipher.AES_256_GCM, GCM_KEY).encrypt(
        bytes.fromhex("cafebabefacedbaddecaf888"),
        GCM_TEXT,
        bytes.fromhex("feedfacedeadbeeffeedfacedeadbeefabaddad2"),
    )
    assert sealed[-TAG_SIZE:].hex() == "76fc6ece0f4e1768cddf8853bb2d551b"


def test_every_counter_has_a_nonce_of_its_own() -> None:
    counters = [0, 1, 255, 256, 2**32, 2**63, 2**64 - 1]
    assert len({counter_nonce(counter) for counter in counters}) == len(counters)
    assert {len(counter_nonce(counter)) for counter in counters} == {12}


@pytest.mark.parametrize("cipher", Cipher)
def test_a_unit_opens_under_its_number_and_place_only(cipher: Cipher) -> None:
    seal = make_seal(1, cipher)
    sealed = seal.seal(7, b"a unit", b"place")
    assert seal.open(7, sealed, b"place") == b"a unit"
    assert seal.open(8, sealed, b"place") is None
    assert seal.open(7, sealed, b"elsewhere") is None
    assert seal.open(7, sealed[:-1], b"place") is None
    assert seal.open(7, sealed[:3], b"place") is None
    assert make_seal(2, cipher).open(7, sealed, b"place") is None


def test_each_hello_has_a_key_of_its_own() -> None:
    publics = [random_bytes(seed)(32) for seed in (1, 2)]
    sealed = seal_once(hello_aead(KEY, publics[0]), b"hello", b"")
    assert open_once(hello_aead(KEY, publics[0]), sealed, b"") == b"hello"
    assert open_once(hello_aead(KEY, publics[1]), sealed, b"") is None
