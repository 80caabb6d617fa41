"""Rules of docstring_lint.py."""

import pytest
from project.docstring_lint import findings

MODULE = '"""{}."""\n\n\nclass A:\n    """{}."""\n\n    async def f(self):\n        r"""{}."""\n'


@pytest.mark.parametrize(
    "word", ["What", "Whether", "How", "That", "Who", "Those", "It", "Where", "Which", "Why"]
)
def test_each_word_is_found_everywhere(word):
    found = findings("a.py", MODULE.format(*[f"{word} is here"] * 3))
    assert found == [f"a.py:{line}: the docstring opens with {word}" for line in (1, 5, 8)]
    assert findings("a.py", f'def f():\n    """\n    {word}.\n    """\n')


def test_noun_and_verb_phrases_pass():
    texts = "Whatever comes first", "Return what it holds", "Items of a list"
    assert findings("a.py", MODULE.format(*texts) + 'B = "What"\n') == []
    assert findings("a.py", "") == []
