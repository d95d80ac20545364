"""``facediff check-install``: what it prints, and what it says of an installation that does not work."""

from __future__ import annotations

import importlib.metadata

import pytest

import facediff
from facediff.cli.app import main


def test_an_installation_that_works(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check-install"]) == 0
    text = capsys.readouterr().out
    for package in ("facediff", "numpy", "onnxruntime"):
        assert f"{package} {importlib.metadata.version(package)}" in text or package == "facediff"
    assert facediff.__version__ in text
    assert "trial: 10 s of sound" in text
    assert text.splitlines()[-1] == "The base installation works."


@pytest.mark.parametrize("fault", [ImportError("DLL load failed"), RuntimeError("no such operator")])
def test_a_fault_is_one_sentence(
    fault: Exception, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def broken(*_: object, **__: object) -> None:
        raise fault

    monkeypatch.setattr(facediff, "load", broken)
    assert main(["check-install"]) == 2
    [line] = capsys.readouterr().err.splitlines()
    assert str(fault) in line
    assert "install facediff again" in line
