"""``facediff check-install``: what it prints, and what it says of an installation that does not work."""

from __future__ import annotations

import importlib.metadata

import pytest

import facediff
from facediff.cli import check_install
from facediff.cli.app import main


def test_an_installation_that_works(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check-install"]) == 0
    text = capsys.readouterr().out
    for package in ("facediff", "numpy", "onnxruntime"):
        assert f"{package} {importlib.metadata.version(package)}" in text or package == "facediff"
    assert facediff.__version__ in text
    assert "trial: 10 s of sound" in text
    assert text.splitlines()[-1] == "The base installation works."


def test_extras_name_what_is_missing(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    required = [
        "numpy>=2",
        "torch>=2.6; extra == 'metrics'",
        "facediff[metrics]; extra == 'train'",
        'av; extra == "all"',
    ]
    monkeypatch.setattr(importlib.metadata, "requires", lambda name: required)
    monkeypatch.setattr(check_install, "version_of", lambda name: None if name == "torch" else "1")
    assert list(check_install.missing("metrics")) == ["torch"]
    assert list(check_install.missing("train")) == ["torch"]
    assert list(check_install.missing("render")) == []
    monkeypatch.setattr(check_install, "extras", lambda: ["metrics", "train", "render"])
    monkeypatch.setattr(check_install, "devices", lambda with_torch: "none")
    check_install.check_install()
    text = capsys.readouterr().out
    assert "extras that are complete: render" in text
    assert 'pip install "facediff[metrics]"' in text


def test_extras_are_those_of_the_project() -> None:
    names = check_install.extras()
    assert {"train", "metrics", "live", "render"} <= set(names)
    assert "all" not in names


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
