"""Texts of the page: every language has all of them."""

from __future__ import annotations

from facediff.study.texts import bundled_texts


def test_every_language_has_every_text() -> None:
    texts = bundled_texts()
    assert set(texts) >= {"en", "de", "zh", "es", "fr"}
    assert next(iter(texts)) == "en"
    for language, words in texts.items():
        assert words.keys() == texts["en"].keys()
        assert words["questions"].keys() == texts["en"]["questions"].keys()
        assert {"{n}", "{total}"} <= set(words["progress"].replace("{", " {").replace("}", "} ").split())
        flat = {**words, **words["questions"]}
        assert all(isinstance(text, str) and text.strip() for name, text in flat.items() if name != "questions")
        same = [name for name, text in flat.items() if text == {**texts["en"], **texts["en"]["questions"]}[name]]
        assert language == "en" or set(same) <= {"pause"}
