"""Licence labels: the strictest decides, and what is not known is not cleared."""

from __future__ import annotations

import itertools

import pytest

from facediff import registry
from facediff.errors import FaceDiffError
from facediff.utils.licences import (
    Commercial,
    Licence,
    commercial_use,
    in_words,
    merged,
    network_licences,
    read_licences,
    require_cleared,
)

RANK: dict[Commercial, int] = {"allowed": 0, "unknown": 1, "forbidden": 2}


@pytest.mark.parametrize("group", list(itertools.product(RANK, repeat=3)))
def test_the_strictest_label_decides_in_any_order(group: tuple[Commercial, ...]) -> None:
    labels = [Licence(f"part {i}", "x", use) for i, use in enumerate(group)]
    assert RANK[commercial_use(labels)] == max(RANK[use] for use in group)
    if set(group) == {"allowed"}:
        require_cleared("model", labels)
        return
    with pytest.raises(FaceDiffError, match="commercial") as caught:
        require_cleared("model.ckpt", labels)
    assert "model.ckpt" in str(caught.value)
    for label in labels:  # what is in the way is named, and nothing else
        assert (label.of in str(caught.value)) == (label.commercial != "allowed")


def test_nothing_known_is_not_cleared() -> None:
    assert commercial_use([]) == "unknown"
    with pytest.raises(FaceDiffError, match="old.ckpt"):
        require_cleared("old.ckpt", [])


def test_inherited_labels_are_kept_once() -> None:
    one, two = Licence("a", "x", "allowed"), Licence("b", "y", "forbidden")
    assert merged([one], [two, one], [two]) == (one, two)
    assert commercial_use(merged([one], [two])) == "forbidden"


@pytest.mark.parametrize(
    "state",
    [
        "x",
        [1],
        [{}],
        [{**Licence("a").state(), "commercial": "yes"}],
        [{**Licence("a").state(), "name": 3}],
        [{**Licence("a").state(), "name": "${oc.env:HOME}"}],
        [{**Licence("a").state(), "source": "a\x1bb"}],
        [{**Licence("a").state(), "more": "x"}],
    ],
)
def test_labels_of_a_file_are_checked(state: object) -> None:
    with pytest.raises(FaceDiffError, match="there"):
        read_licences("there", state)


def test_labels_survive_being_stored() -> None:
    labels = (Licence("a", "Apache-2.0", "allowed", "x.org"), Licence("b"))
    assert read_licences("file", [each.state() for each in labels]) == labels
    assert "Apache-2.0" in in_words(labels)
    assert "unknown" in in_words(labels)


def test_every_bundled_corpus_states_its_terms_and_where_they_stand() -> None:
    found = {entry.name: entry.implementation.corpus_licence() for entry in registry.corpus}
    known = {name: found[name].commercial for name in ("Biwi", "Vocaset", "Mead3D", "Puppet")}
    assert known == {"Biwi": "forbidden", "Vocaset": "forbidden", "Mead3D": "forbidden", "Puppet": "allowed"}
    assert all(found[name].source and found[name].name != "unknown" for name in known)


def test_pretrained_networks_are_labelled_wherever_the_options_name_them() -> None:
    options = {
        "audio_encoder": {"init_args": {"config": {"_name_or_path": "facebook/hubert-base-ls960"}}},
        "others": [{"config": {"_name_or_path": "somebody/something"}}, {"config": {"_name_or_path": "/home/me/x"}}],
        "own": {"config": {"_name_or_path": ""}},
    }
    labels = network_licences(options)
    assert [label.commercial for label in labels] == ["allowed", "unknown", "unknown"]
    assert not any("/home" in str(label.state()) for label in labels)
