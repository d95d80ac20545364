"""The data module of the built-in corpus."""

from pathlib import Path

from facediff import synthetic as puppet
from facediff.data import Puppet
from facediff.synthetic.corpus import generate


def test_data_module_trains_on_drawn_speakers_and_compares_the_eight(tmp_path: Path) -> None:
    root = tmp_path / "corpus"
    generate(root, only=["F1_e01", "F1_e04", "F4_e01", "X01_e01", "X01_e04"], progress=False, drawn=2)
    data = Puppet(root=str(root), drawn_speakers=2)
    data.setup("fit")
    assert data.identities == [*puppet.SEEN_IDENTITIES, "X01", "X02"]
    assert len(data.train_dataloader().dataset) == 4  # all but the unseen speaker's clip
    assert data.compared_speakers == (*puppet.SEEN_IDENTITIES, *puppet.UNSEEN_IDENTITIES)
    assert Puppet(drawn_speakers=2).root != Puppet().root
