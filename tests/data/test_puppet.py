"""The data module of the built-in corpus."""

from pathlib import Path

import pytest

from facediff import synthetic as puppet
from facediff.data import Puppet
from facediff.data.puppet import FirstEdition, SecondEdition
from facediff.errors import FaceDiffError
from facediff.synthetic.corpus import generate


def test_data_module_trains_on_drawn_speakers_and_compares_the_eight(tmp_path: Path) -> None:
    root = tmp_path / "corpus"
    generate(root, only=["F1_e01", "F1_e04", "F4_e01", "X01_e01", "X01_e04"], progress=False, drawn=2)
    data = Puppet(root=str(root), drawn_speakers=2)
    data.setup("fit")
    assert data.identities == [*puppet.SEEN_IDENTITIES, "X01", "X02"]
    assert len(data.train_dataloader().dataset) == 4  # all but the unseen speaker's clip
    assert set(data.assets().references) == {"F1", "F4"}  # a checkpoint keeps no clips of drawn speakers
    assert data.compared_speakers == (*puppet.SEEN_IDENTITIES, *puppet.UNSEEN_IDENTITIES)
    assert Puppet(drawn_speakers=2).root != Puppet().root


def test_a_folder_says_which_edition_it_holds(tmp_path: Path) -> None:
    generate(tmp_path / "first", only=["F1_e01"], progress=False)
    assert isinstance(Puppet(root=str(tmp_path / "first")).edition, FirstEdition)
    assert Puppet(root=str(tmp_path / "first")).n_vertices == 1008
    assert isinstance(Puppet(root=str(tmp_path / "none")).edition, SecondEdition)
    assert Puppet(edition=1).root != Puppet().root
    assert Puppet(edition=1).compared_speakers != Puppet().compared_speakers
    with pytest.raises(FaceDiffError, match="edition"):
        Puppet(root=str(tmp_path / "first"), people_voices=True)
