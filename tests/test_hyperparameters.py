"""Options in a dataclass: as if they were arguments of a constructor, documented, checked and stored the same way."""

from __future__ import annotations

import inspect
from dataclasses import fields

import pytest

from facediff import registry
from facediff.errors import FaceDiffError
from facediff.models.base import AnimationModel
from facediff.models.dual_path.model import DualPathOptions
from facediff.models.style_content.model import StyleContentOptions
from facediff.utils.hints import hints_of, options_of
from tests.fakes.tiny import Tiny

MODELS = {"DualPathDiffusion": DualPathOptions, "StyleContentDisentanglement": StyleContentOptions}


@pytest.mark.parametrize("name", MODELS)
def test_options_of_a_dataclass_are_those_of_the_constructor(name: str, tiny: Tiny) -> None:
    cls, group = registry.model.get(name), MODELS[name]
    options = options_of(cls)
    for field in fields(group):
        assert options[field.name].default is field.default
        assert options[field.name].annotation == hints_of(group)[field.name]
        assert f"{field.name}: " in (inspect.getdoc(cls.__init__) or ""), f"{field.name} is not documented"
    assert options_of(AnimationModel).keys() <= options.keys()
    model = cls.for_data(tiny, dim=16)
    assert model.options.dim == model.hparams["dim"] == 16
    with pytest.raises(FaceDiffError, match=r"model\.dim"):
        cls.for_data(tiny, dim=0)
    with pytest.raises(TypeError, match="nonsense"):
        cls.for_data(tiny, nonsense=1)
