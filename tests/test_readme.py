"""The example of the README runs as it stands there, and says what the text says."""

import re
from pathlib import Path

README = Path(__file__).parents[1] / "README.md"


def test_the_readme_example_runs(capsys):
    blocks = re.findall(r"```python\n(.*?)```", README.read_text(encoding="utf-8"), re.DOTALL)
    assert len(blocks) == 1
    namespace = {}
    exec(compile(blocks[0], str(README), "exec"), namespace)
    assert float(capsys.readouterr().out.splitlines()[0]) > 0.99
    assert namespace["y_new"].index.equals(namespace["u"].index)
    assert namespace["pipe"]["match"].system_.nstates == 3
