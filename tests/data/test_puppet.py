"""The data module of the built-in corpus."""

from pathlib import Path

import numpy as np
import soundfile
import torch

from facediff.data import Puppet
from facediff.data.batch import Rig
from facediff.spaces import layout
from facediff.spaces.files import ParameterClip, write_parameters
from facediff.synthetic.cast import SEEN, UNSEEN
from facediff.synthetic.corpus import generate


def test_data_module_trains_on_drawn_speakers_and_compares_the_ten(tmp_path: Path) -> None:
    root = tmp_path / "corpus"
    generate(root, only=["F1_e01", "F1_e04", "F4_e01", "X01_e01", "X01_e04"], progress=False, drawn=2)
    data = Puppet(root=str(root), drawn_speakers=2)
    data.setup("fit")
    assert data.identities == [*SEEN, "X01", "X02"]
    assert len(data.train_dataloader().dataset) == 4  # all but the unseen speaker's clip
    assert set(data.assets().references) == {"F1", "F4"}  # a checkpoint keeps no clips of drawn speakers
    assert data.compared_speakers == (*SEEN, *UNSEEN)
    assert Puppet(drawn_speakers=2).root != Puppet().root


def test_channels_are_the_truth_of_the_vertices(tmp_path: Path) -> None:
    generate(tmp_path / "second", only=["F1_t03"], progress=False)
    channels, vertices = (Puppet(root=str(tmp_path / "second"), motion=motion) for motion in ("arkit", "vertices"))
    clip = channels.corpus.clips["F1_t03"]
    motion = channels.corpus.read_motion(clip)
    assert motion.shape[1:] == (63, 1)
    assert channels.space.channels[54:57] == ("HeadYaw", "HeadPitch", "HeadRoll")
    rig = Rig(vertices.assets(), channels.deltas())
    torch.testing.assert_close(
        rig.decode(motion, channels.space, "F1"), vertices.corpus.read_motion(clip), atol=1e-6, rtol=0
    )
    # Pitch, yaw and roll in degrees on disk; where the eyes look, to the left and up.
    head, gaze = (np.load(tmp_path / "second" / f"{name}_npy" / "F1_t03.npy") for name in ("head", "gaze"))
    np.testing.assert_allclose(motion[:, 54:57, 0], np.deg2rad(head[:, [1, 0, 2]] * [1, 1, -1]), atol=1e-6)
    np.testing.assert_allclose(motion[:, 57:59, 0], np.deg2rad(gaze * [1, -1]), atol=1e-6)
    assert torch.equal(motion[:, 57:60], motion[:, 60:63])
    # Somebody imported from a phone is read in the corpus's channels, and has the mean face.
    person = tmp_path / "ann"
    person.mkdir()
    values = np.random.default_rng(0).random((60, 61)).astype(np.float32)
    write_parameters(person / "Ann_s01.csv", ParameterClip("Ann_s01", values, layout("live_link"), 25.0))
    soundfile.write(person / "Ann_s01.wav", np.zeros(38_400), 16_000)
    (person / "clips.csv").write_text("clip,split\nAnn_s01,train\n")
    (person / "manifest.json").write_text('{"person": "Ann", "layout": "live_link"}')
    joined = Puppet(root=str(tmp_path / "second"), motion="arkit", people=[str(person)])
    own = joined.corpus.read_motion(joined.corpus.clips["Ann_s01"])
    for name in ("jawOpen", "HeadYaw", "RightEyePitch"):
        np.testing.assert_allclose(
            own[:, joined.space.index(name), 0], values[:, layout("live_link").index(name)], atol=1e-6
        )
    assert not own[:, joined.space.index("tongueUp")].any()
    shown = joined.assets().rig
    assert shown is not None
    mean = torch.stack([face for name, face in shown.mesh.templates.items() if name != "Ann"]).mean(0)
    torch.testing.assert_close(shown.mesh.templates["Ann"], mean)
    assert "Ann" not in shown.deltas
