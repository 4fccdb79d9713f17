"""`jaxfit doctor` names every part, and the remedy for a part that is missing."""

from jaxfit.cli import doctor
from jaxfit.cli.main import main


def lines_of(findings):
    return {finding.part: finding for finding in findings}


def test_every_part_stands_on_the_page(capsys):
    assert main(["doctor"]) == 0
    said = capsys.readouterr().out
    for part in ("processor", "kernels", "FFmpeg", "codecs that are written", "built-in segmenter", "h5py", "cache"):
        assert part in said
    assert "fails" not in said


def test_missing_parts_have_a_remedy(monkeypatch):
    monkeypatch.setattr("jaxfit.foundation.extras.find_spec", lambda name: None)
    packages = lines_of(doctor._checked(doctor._optional_packages))
    assert packages["pynwb"].state == "missing"
    assert 'pip install --upgrade ".[formats]" in the checkout' in packages["pynwb"].remedy
    monkeypatch.setenv("JAXFIT_KERNEL_ISA", "none")
    assert "unset JAXFIT_KERNEL_ISA" in doctor._checked(doctor._kernels)[0].remedy
    monkeypatch.setattr(doctor, "_has_codec", lambda name, mode: name != "libx264")
    codecs = lines_of(doctor._checked(doctor._ffmpeg))
    assert codecs["codecs that are written"].state == "vp9, mpeg4; without h264"
    assert codecs["codecs that are written"].remedy


def test_a_broken_library_is_a_finding():
    def _broken_part():
        raise OSError("libav.so: cannot open")
        yield

    assert doctor._checked(_broken_part)[0].state == "fails: OSError: libav.so: cannot open"


def test_optional_packages_are_no_faults(capsys, monkeypatch):
    packages = [doctor.Finding("pynwb", "missing", "install it", optional=True)]
    monkeypatch.setattr(doctor, "_CHECKS", (lambda: iter([doctor.Finding("kernels", "avx2"), *packages]),))
    assert main(["doctor"]) == 0
    assert capsys.readouterr().out.splitlines()[-2:] == [
        "everything that jaxfit requires works",
        "1 optional package is not installed, or too old: → says which commands need them",
    ]
    monkeypatch.setattr(doctor, "_CHECKS", (lambda: iter([doctor.Finding("kernels", "none", "compile them")]),))
    assert main(["doctor"]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == ("1 part missing or in need of repair: → says what to do")


def test_a_long_path_leaves_the_parts_readable(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    found = [doctor.Finding("built-in keypoint network", "loads"), doctor.Finding("cache", "/long" * 60)]
    monkeypatch.setattr(doctor, "_CHECKS", (lambda: iter(found),))
    assert main(["doctor"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert any("built-in keypoint network" in line and "loads" in line for line in lines)
    assert max(map(len, lines)) <= 80
