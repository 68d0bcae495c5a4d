# SPDX-License-Identifier: MIT
"""Transliteration to ASCII for ids and file names: Küche becomes Kueche, Öl-Eiche Oel-Eiche.

German umlauts become two letters; other accents are removed. Tables map Greek, Cyrillic and those Latin
letters that cannot be decomposed into a base letter and an accent (ø, ł, ß). Letters of other alphabets
become their code points, so that distinct names stay distinct.
"""

from __future__ import annotations

import unicodedata

_LATIN = {
    "ä": "ae", "ö": "oe", "ü": "ue", "ß": "ss", "æ": "ae", "œ": "oe", "ø": "o", "ð": "d", "þ": "th",
    "đ": "d", "ħ": "h", "ı": "i", "ł": "l", "ŋ": "ng", "ŧ": "t", "ə": "e", "ĸ": "k", "ʻ": "", "ʼ": "",
    "’": "", "×": "x",
}  # fmt: skip
_GREEK = {
    "α": "a", "β": "v", "γ": "g", "δ": "d", "ε": "e", "ζ": "z", "η": "i", "θ": "th", "ι": "i", "κ": "k",
    "λ": "l", "μ": "m", "ν": "n", "ξ": "x", "ο": "o", "π": "p", "ρ": "r", "σ": "s", "ς": "s", "τ": "t",
    "υ": "y", "φ": "f", "χ": "ch", "ψ": "ps", "ω": "o",
}  # fmt: skip
_CYRILLIC = {
    "а": "a", "б": "b", "в": "v", "г": "g", "д": "d", "е": "e", "ж": "zh", "з": "z", "и": "i", "й": "y",
    "к": "k", "л": "l", "м": "m", "н": "n", "о": "o", "п": "p", "р": "r", "с": "s", "т": "t", "у": "u",
    "ф": "f", "х": "kh", "ц": "ts", "ч": "ch", "ш": "sh", "щ": "shch", "ъ": "", "ы": "y", "ь": "", "э": "e",
    "ю": "yu", "я": "ya", "ё": "yo", "є": "ye", "і": "i", "ї": "yi", "ґ": "g", "ђ": "dj", "ј": "j",
    "љ": "lj", "њ": "nj", "ћ": "c", "џ": "dz", "ѕ": "dz",
}  # fmt: skip
_TABLE = {**_LATIN, **_GREEK, **_CYRILLIC}


def transliterated(text: str) -> str:
    """Return ``text`` in ASCII; symbols without a counterpart become spaces."""
    text = unicodedata.normalize("NFC", text)
    neighbours = zip(text, f" {text}", f"{text[1:]} ", strict=False)
    return "".join(_letters(c, after.isupper() or before.isupper()) for c, before, after in neighbours)


def _letters(letter: str, is_in_capitals: bool) -> str:
    """Return the ASCII form of a letter: Ä becomes AE if ``is_in_capitals`` (next to a capital), else Ae."""
    if letter.isascii():
        return letter
    small = letter.lower()
    if small in _TABLE:
        written = _TABLE[small]
        return written if letter == small else written.upper() if is_in_capitals else written.capitalize()
    plain = "".join(c for c in unicodedata.normalize("NFKD", letter) if not unicodedata.combining(c))
    if plain.isascii():
        return plain
    if plain != letter:
        return "".join(_letters(part, is_in_capitals) for part in plain)
    return f" u{ord(letter):04x} " if letter.isalnum() else " "
