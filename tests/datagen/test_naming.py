# SPDX-License-Identifier: MIT
"""Names in other languages become readable, distinct ids, which are the same in the Blender add-on."""

from __future__ import annotations

import unicodedata

import pytest
from hypothesis import given
from hypothesis import strategies as st

from datagen.formats.base import Slug as SlugType
from datagen.formats.base import StrictModel, parse_model
from datagen.foundation.naming import slug
from datagen.foundation.transliteration import transliterated
from tests.conftest import REPOSITORY


class _Named(StrictModel):
    id: SlugType


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("Küche", "kueche"),
        ("Öl-Eiche", "oel-eiche"),
        ("ÜBERGRÖSSE", "uebergroesse"),
        ("Straße", "strasse"),
        ("façade crème", "facade-creme"),
        ("Salón Niño", "salon-nino"),
        ("køkken", "kokken"),
        ("šatní skříň", "satni-skrin"),
        ("Łóżko", "lozko"),
        ("ışık", "isik"),
        ("кухня", "kukhnya"),
        ("Κουζίνα", "koyzina"),
        ("Nội thất", "noi-that"),
        ("½ ﬁr ２", "1-2-fir-2"),
        ("厨房", "u53a8-u623f"),
        ("Oak (dark)", "oak-dark"),
        ("LivingRoom", "living_room"),
        ("!", "unnamed"),
    ],
)
def test_names_are_transliterated(name: str, expected: str) -> None:
    """Umlauts, accents and other alphabets are transliterated in composed and decomposed Unicode form."""
    for form in ("NFC", "NFD"):
        assert slug(unicodedata.normalize(form, name)) == expected


def test_other_alphabets_stay_distinct() -> None:
    assert len({slug(name) for name in ("厨房", "卧室", "キッチン", "مطبخ", "מטבח", "ห้องครัว")}) == 6


@given(st.text(max_size=40))
def test_every_name_becomes_an_id(name: str) -> None:
    assert transliterated(name).isascii()
    parse_model(_Named, {"id": slug(name)}, "name")


@given(st.text(alphabet=st.characters(max_codepoint=127), max_size=40))
def test_ascii_is_unchanged(name: str) -> None:
    assert transliterated(name) == name


def test_the_add_on_transliterates_identically() -> None:
    """The add-on has a copy of the module, because it imports no other package of the project."""
    paths = ("datagen/foundation/transliteration.py", "blender_addon/gather/transliteration.py")
    here, there = ((REPOSITORY / path).read_text() for path in paths)
    assert here == there
    tags = (REPOSITORY / "blender_addon" / "gather" / "tags.py").read_text()
    assert "transliterated(name).lower()" in tags
