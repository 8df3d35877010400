"""The notebook for newcomers: what it shows, and that it runs."""

import json
import os
import re
import sys
from pathlib import Path

import pytest

NOTEBOOK = Path(__file__).parents[2] / "examples" / "start.ipynb"


def code_cells():
    cells = json.loads(NOTEBOOK.read_text())["cells"]
    return [cell for cell in cells if cell["cell_type"] == "code"]


def test_ten_cells_with_their_output_and_no_error():
    cells = code_cells()
    assert [int(re.match(r"# (\d+)\.", cell["source"][0])[1]) for cell in cells] == [*range(1, 11)]
    for cell in cells:
        assert cell["outputs"]
        assert {output["output_type"] for output in cell["outputs"]} <= {"stream", "display_data"}
    assert not re.search(r"/(home|root|tmp|work)/", NOTEBOOK.read_text())


@pytest.mark.slow
def test_the_notebook_runs(tmp_path, monkeypatch):
    """In IPython, without a Jupyter kernel."""
    from IPython.core.interactiveshell import InteractiveShell

    monkeypatch.chdir(tmp_path)
    folder = str(Path(sys.executable).parent)
    monkeypatch.setenv("PATH", folder + os.pathsep + os.environ["PATH"])
    monkeypatch.setenv("MPLBACKEND", "agg")
    shell = InteractiveShell.instance()
    for cell in code_cells():
        text = "".join(cell["source"]).replace("%matplotlib inline\n", "")
        shell.run_cell(text).raise_error()
        assert shell.user_ns.get("_exit_code", 0) == 0, text
    assert (tmp_path / "runs" / "site" / "index.html").is_file()
