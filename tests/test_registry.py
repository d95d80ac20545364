"""Names are paths of classes; wrong names, clashes and broken plug-ins are told plainly."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path

import pytest
from jsonargparse import ArgumentParser

from facediff import registry
from facediff.errors import FaceDiffError
from facediff.models.decoders import Decoder, GruDecoder
from facediff.registry import Kind, RegistrationError, UnknownComponentError, alias_path


@pytest.fixture
def shelf(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Kind:
    """A kind of its own, whose package is empty, so that tests leave the real ones alone."""
    (tmp_path / "empty_shelf").mkdir()
    (tmp_path / "empty_shelf" / "__init__.py").touch()
    monkeypatch.syspath_prepend(tmp_path)
    return Kind("gadget", "empty_shelf", "things for tests", component=True)


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Put a distribution with one gadget on the path, as an unpacked wheel would be."""

    def put(distribution: str, name: str, target: str, source: str) -> None:
        site = tmp_path / f"site_{distribution}"
        info = site / f"{distribution}-1.0.dist-info"
        info.mkdir(parents=True)
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {distribution}\nVersion: 1.0\n")
        (info / "entry_points.txt").write_text(f"[facediff.gadget]\n{name} = {target}\n")
        (site / f"{target.partition(':')[0]}.py").write_text(source)
        monkeypatch.syspath_prepend(site)

    return put


@pytest.mark.parametrize("kind", registry.COMPONENTS)
def test_every_name_is_the_path_of_its_class(kind: str) -> None:
    assert registry.COMPONENTS[kind].names()
    for entry in registry.COMPONENTS[kind]:
        assert getattr(getattr(registry, kind), entry.name) is entry.implementation
        assert alias_path(entry.implementation) == f"facediff.registry.{kind}.{entry.name}"
        assert entry.summary, f"{entry.owner} has no docstring"


@pytest.mark.parametrize("word", ["GruDecoder", "facediff.registry.decoder.gru"])
def test_jsonargparse_resolves_the_word(word: str) -> None:
    registry.decoder.load()
    parser = ArgumentParser(exit_on_error=False)
    parser.add_subclass_arguments(Decoder, "decoder")
    parsed = parser.parse_args(
        [f"--decoder={word}", "--decoder.dim=4", "--decoder.style_dim=4", "--decoder.num_layers=1"]
    )
    decoder = parser.instantiate_classes(parsed).decoder
    assert isinstance(decoder, GruDecoder)
    assert decoder.gru.num_layers == 1


def test_names_in_a_config_become_paths() -> None:
    path = "facediff.registry"
    written = {
        "model": {"init_args": {"decoder": {"class_path": "gru", "init_args": {"dropout": 0.0}}, "fusion": "add"}},
        "other": [{"class_path": "components"}, {"decoder": "my.Decoder", "sampler": None}],
    }
    assert registry.with_paths(written) == {
        "model": {
            "init_args": {
                "decoder": {"class_path": f"{path}.decoder.gru", "init_args": {"dropout": 0.0}},
                "fusion": f"{path}.fusion.add",
            }
        },
        "other": [{"class_path": "components"}, {"decoder": "my.Decoder", "sampler": None}],  # of two kinds
    }
    assert registry.with_paths({"class_path": "gru"}) == {"class_path": f"{path}.decoder.gru"}


def test_unknown_names_list_the_nearest_and_all() -> None:
    with pytest.raises(UnknownComponentError) as caught:
        registry.decoder.get("grru")
    assert 'no decoder "grru"' in str(caught.value)
    assert 'did you mean "gru"?' in str(caught.value)
    assert all(name in str(caught.value) for name in registry.decoder.names())
    assert isinstance(caught.value, FaceDiffError)
    assert "did you mean" not in registry.decoder.unknown("xyzzy")
    assert not hasattr(registry.decoder, "grru")


def test_malformed_and_reserved_names_are_refused(shelf: Kind) -> None:
    for name in ("Gru", "two words", "a-b", "1st", "", "_hidden", "class", "register", "names", "kind", "title"):
        with pytest.raises(RegistrationError, match="cannot be registered"):
            shelf.register(name)(GruDecoder)
        assert name not in shelf.names()


def test_a_clash_names_both_owners(shelf: Kind) -> None:
    shelf.register("thing")(GruDecoder)
    shelf.register("thing")(GruDecoder)  # the same class again, as when a module is reloaded
    with pytest.raises(RegistrationError) as caught:
        shelf.register("thing")(Decoder)
    for owner in (GruDecoder, Decoder):
        assert f"{owner.__module__}.{owner.__qualname__}" in str(caught.value)
    assert shelf.entries()[0].implementation is GruDecoder


def test_a_plug_in_is_found(shelf: Kind, install: Callable[..., None]) -> None:
    install("good-gadgets", "spinner", "good_gadgets:Spinner", 'class Spinner:\n    """Spins."""\n')
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert shelf.names() == ["spinner"]
    assert shelf.entries()[0].summary == "Spins."


@pytest.mark.parametrize(
    ("name", "source", "reason"),
    [
        ("spinner", "import no_such_module_anywhere\n", "no_such_module_anywhere"),
        ("spinner", "x = 1\nraise SystemError('on fire')\n", "broken_gadgets_1.py, line 2: SystemError: on fire"),
        ("spinner", "x = 1\nclass Spinner\n", "broken_gadgets_2.py, line 2: SyntaxError: expected ':'"),
        ("spinner", "", "has no attribute 'Spinner'"),
        ("spinner", "Spinner = 3\n", "3, which is no class"),
        ("Spinner-3", "class Spinner: ...\n", "lower snake case"),
        ("taken", "class Spinner: ...\n", "facediff.models.decoders.GruDecoder"),
    ],
)
def test_a_broken_plug_in_is_a_warning_that_names_it(
    shelf: Kind, install: Callable[..., None], name: str, source: str, reason: str, request: pytest.FixtureRequest
) -> None:
    shelf.register("taken")(GruDecoder)
    module = f"broken_gadgets_{request.node.callspec.indices['name']}"
    install("broken-gadgets", name, f"{module}:Spinner", source)
    with pytest.warns(UserWarning, match=rf'"{name}" of the installed package "broken-gadgets"') as caught:
        assert shelf.names() == ["taken"]
    assert reason in str(caught[0].message)
    assert shelf.get("taken") is GruDecoder
