import base64

import pytest

from rig_protocol.errors import DataError
from rig_protocol.rig_key import KEY_SIZE, RigKey
from support.wire import KEY, random_bytes


def test_a_key_survives_its_text_which_is_one_line_of_a_file() -> None:
    text = KEY.to_text()
    assert RigKey.parse(text) == KEY
    assert text.splitlines() == [f"kinect-rig-key-1 {base64.b64encode(KEY.secret).decode()}"]
    assert RigKey.parse(f"\n  {text}  \n") == KEY


@pytest.mark.parametrize(
    ("text", "advice"),
    [
        ("", "rig-server keygen"),
        ("kinect-rig-key-1", "rig-server keygen"),
        ("kinect-rig-key-2 AAAA", "rig-server keygen"),
        (KEY.to_text() * 2, "rig-server keygen"),
        ("-----BEGIN OPENSSH PRIVATE KEY-----", "rig-server keygen"),
        (KEY.to_text()[:-5], "copy the file again"),
        (KEY.to_text().replace("=", ""), "copy the file again"),
        (KEY.to_text().replace("A", "?", 1), "copy the file again"),
        ("kinect-rig-key-1 " + base64.b64encode(bytes(31)).decode(), "copy the file again"),
        ("kinect-rig-key-1 " + base64.b64encode(bytes(33)).decode(), "copy the file again"),
    ],
)
def test_text_that_holds_no_key_is_told_what_to_do(text: str, advice: str) -> None:
    with pytest.raises(DataError, match=advice):
        RigKey.parse(text)


def test_no_text_of_a_key_or_of_an_error_shows_the_secret() -> None:
    secret = base64.b64encode(KEY.secret).decode()
    with pytest.raises(DataError) as caught:
        RigKey.parse(KEY.to_text()[:-5])
    for shown in (repr(KEY), str(KEY), f"{KEY}", str(caught.value)):
        assert secret[:8] not in shown
        assert KEY.secret.hex()[:8] not in shown
        assert repr(KEY.secret)[2:10] not in shown


def test_a_generated_key_is_what_the_source_gives_and_not_public() -> None:
    assert RigKey.generate(random_bytes(1)) == RigKey(random_bytes(1)(KEY_SIZE))
    assert not RigKey.generate(random_bytes(1)).is_public


def test_the_key_of_insecure_is_public_and_says_so() -> None:
    assert RigKey.INSECURE.is_public
    assert b"anybody may join" in RigKey.INSECURE.secret


@pytest.mark.parametrize("size", [0, 31, 33])
def test_a_key_of_another_size_is_misuse(size: int) -> None:
    with pytest.raises(ValueError, match="32 bytes"):
        RigKey(bytes(size))
