"""Rule: a Pi compiles nothing. Whatever an agent needs is there as a binary wheel, in the pinned version."""

import pytest

from support import pi_wheels


@pytest.mark.network
def test_every_dependency_of_an_agent_is_a_wheel_for_64_bit_debian_12() -> None:
    try:
        files = pi_wheels.resolve()
    except AssertionError:
        if not pi_wheels.index_answers():
            pytest.skip("no package index answers: pip must reach one to say what a Pi would install")
        raise
    print("\n".join(files))
    assert len(files) >= len(pi_wheels.agent_requirements())
    assert all(file.endswith(("_aarch64.whl", "-none-any.whl")) for file in files)
