"""`python -m tippe`."""

import json

import jax
import pytest
import xarray

from tippe.__main__ import drawn, main, parser

SMALL = ["--theta", "0.1", "0.3", "--eta", "0", "--t1", "12", "--tolerance", "1e-7"]


def test_the_main_job_prints_writes_and_draws(tmp_path, capsys):
    assert main([*SMALL, "--out", str(tmp_path / "out")]) == 0
    printed = capsys.readouterr().out
    assert "Table 1 lost its numbers" in printed
    assert "first [s]" in printed
    assert "9.98" in printed
    assert (tmp_path / "out" / "theta.png").read_bytes().startswith(b"\x89PNG")
    shown = tmp_path / "out" / "index.html"
    assert printed.rstrip().endswith(f"To see it, open {shown}")
    page = shown.read_text()
    assert "<td>9.98" in page
    assert 'id="snapshot1"' in page
    assert "data:image/png" in page
    with xarray.open_dataset(tmp_path / "out" / "cylinder.h5", engine="h5netcdf") as data:
        assert data["first_time"].dims == ("theta", "eta")
        assert json.loads(data.attrs["request"])["scene.surface"] == "Cylinder"
    # The same again is read from the files; another scene in the same folder is refused.
    assert main([*SMALL, "--out", str(tmp_path / "out")]) == 0
    capsys.readouterr()
    assert main([*SMALL, "--mu", "0.2", "--out", str(tmp_path / "out")]) == 2
    printed = capsys.readouterr().err
    assert "scene.friction.mu is 0.3 there and 0.2 here" in printed


def test_picture_and_page_share_their_programs(caplog):
    """The page shows a shorter time, and other jobs have another tolerance; neither is compiled anew."""
    drawn(parser().parse_args(SMALL), 12.0)
    # For all threads, which `jax.log_compiles` is not.
    jax.config.update("jax_log_compiles", True)
    try:
        times, runs = drawn(parser().parse_args([*SMALL, "--tolerance", "1e-6"]), 2.0)
    finally:
        jax.config.update("jax_log_compiles", False)
    assert runs["plane"].theta.shape == (2, len(times))
    assert "Compiling" not in caplog.text


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--mass", "-1"], "mass = -1.0 must be greater than 0.0"),
        (["--offset", "0.03"], "offset = 0.03 must be less than 0.02"),
        (["--cylinder-radius", "0.01"], "surface radius = 0.01 must be greater than 0.02"),
        (["--theta", "4"], "theta = .*4.* must be at most 3.14159"),
        (["--mu", "nan"], "mu = nan must be finite"),
        (["--out", "/proc/nowhere"], "/proc/nowhere"),
        (["--surface", "plane", "steep"], "--surface plane steep must be one of: sphere RADIUS, "),
        (["--surface", "torus", "0.3", "0.01"], r"tube = 0.01 must be greater than 0.02 \(the body must fit inside\)"),
    ],
)
def test_bad_input_is_one_clear_line(arguments, message, capsys, tmp_path):
    import re

    assert main([*SMALL, "--out", str(tmp_path), *arguments]) == 2
    printed = capsys.readouterr().err.strip()
    assert re.search(message, printed)
    assert len(printed.splitlines()) == 1


def test_every_option_is_explained():
    printed = parser().format_help()
    for word in ("mass [kg]", "cylinder", "[rad/s]", "slip speed", "horizon", "Table 1"):
        assert word in printed
