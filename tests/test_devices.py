"""Batches over several devices are as on one, and each device has its part."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from several_devices import DEVICES, PARTS

HERE = Path(__file__).parent


@pytest.mark.slow
@pytest.mark.parametrize("part", PARTS)
def test_several_devices_do_what_one_does(part: str) -> None:
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count={DEVICES}"
    done = subprocess.run(
        [sys.executable, str(HERE / "several_devices.py"), part],
        env={**os.environ, "XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
