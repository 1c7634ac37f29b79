"""The same numbers as before, to rounding: see `reference_numbers`.

They are made by a process of its own, with XLA as users have it and not as the tests set it.
"""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import reference_numbers

pytestmark = pytest.mark.slow

# Rounding of float32 over ten loads; another processor, or another order of operations, does that
# much. A change of the method does far more.
RELATIVE = 2e-4
# Where the way to the receiver counts: its search may end at another of ways almost as short.
RELATIVE_OF_WAYS = 0.01


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> dict[str, np.ndarray]:
    path = tmp_path_factory.mktemp("numbers") / "numbers.npz"
    others = {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}
    script = Path(reference_numbers.__file__)
    subprocess.run([sys.executable, str(script), str(path)], check=True, env=others)
    with np.load(path, allow_pickle=False) as file:
        return dict(file)


@pytest.mark.parametrize("group", reference_numbers.GROUPS)
def test_the_numbers_are_the_same(found: dict[str, np.ndarray], group: str) -> None:
    with np.load(reference_numbers.FILE, allow_pickle=False) as stored:
        wanted = {name: stored[name] for name in stored if name.split(" ")[0] == group}
    assert {name for name in found if name.split(" ")[0] == group} == set(wanted)
    for name, want in wanted.items():
        scale = max(float(np.abs(want).max()), 1e-6)
        of_ways = any(word in name for word in ("cost", "transport"))
        relative = RELATIVE_OF_WAYS if of_ways else RELATIVE
        np.testing.assert_allclose(found[name], want, rtol=0.0, atol=relative * scale, err_msg=name)
