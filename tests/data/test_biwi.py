"""BIWI: splits and identity order against hand-written lists."""

from __future__ import annotations

from pathlib import Path

from facediff.data import Biwi
from tests.fakes.mini import SEEN, UNSEEN, MiniBiwi, names_of, write


def test_biwi_has_the_splits_of_the_field(tmp_path: Path) -> None:
    people = [*(f"F{i}" for i in range(1, 9)), *(f"M{i}" for i in range(1, 7))]
    neutral = ["F2_01", "F1_40", "M3_33"]
    everything = [f"{p}_e{n:02d}" for p in people for n in range(1, 41)]
    data = MiniBiwi(root=str(write(tmp_path, [*everything, *neutral], set(people), frames=1)))
    expected = {
        "train": [f"{p}_e{n:02d}" for p in SEEN for n in range(1, 33)],
        "val": [f"{p}_e{n:02d}" for p in SEEN for n in (33, 34, 35, 36)],
        "test_a": [f"{p}_e{n:02d}" for p in SEEN for n in (37, 38, 39, 40)],
        "test_b": [f"{p}_e{n:02d}" for p in UNSEEN for n in (37, 38, 39, 40)],
    }
    assert {split: sorted(names) for split, names in expected.items()} == names_of(data)
    assert [len(names) for names in expected.values()] == [192, 24, 24, 32]
    assert {s: sorted(n) for s, n in Biwi.expected_clips().items()} == {s: sorted(n) for s, n in expected.items()}
    assert data.identities == SEEN
    assert not any(name in data.corpus.clips for name in neutral)
    # Unseen people's style comes from sentences that nothing is scored on.
    assert all(int(s.reference_name[-2:]) < 37 for s in data.dataset("test_b"))
