"""The README's Python lines run as they stand, and the files it names exist."""

import re
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]


def test_the_python_example_runs(capsys):
    """The object, in the dozen lines that the README shows."""
    code = re.search(r"```python\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), re.DOTALL)
    assert code is not None
    names: dict[str, object] = {}
    exec(code[1], names)
    estimate = names["estimate"]
    assert len(estimate.landmarks) == 35
    assert np.linalg.eigvalsh(estimate.covariance)[0] > 0.0
    assert "35" in capsys.readouterr().out


def test_the_files_it_names_exist():
    """Links and pictures."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    for target in re.findall(r"\]\(([^)#]+)\)", text):
        assert (ROOT / target).exists(), target
