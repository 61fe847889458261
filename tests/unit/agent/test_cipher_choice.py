import pytest

from rig_agent import cipher_choice
from rig_protocol.security import Cipher


def test_all_ciphers_are_offered_the_quickest_first(monkeypatch: pytest.MonkeyPatch) -> None:
    times = {Cipher.AES_256_GCM: 2.0, Cipher.CHACHA20_POLY1305: 1.0}
    monkeypatch.setattr(cipher_choice, "_seconds", times.__getitem__)
    cipher_choice.ciphers_by_speed.cache_clear()
    assert cipher_choice.ciphers_by_speed() == (Cipher.CHACHA20_POLY1305, Cipher.AES_256_GCM)
    cipher_choice.ciphers_by_speed.cache_clear()


@pytest.mark.parametrize("cipher", Cipher)
def test_a_cipher_is_timed_on_a_frame(cipher: Cipher) -> None:
    assert 0 < cipher_choice._seconds(cipher) < 1
