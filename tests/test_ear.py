"""One ear: the same impacts, whatever asks for them."""

from pathlib import Path

import cgid


def test_nothing_but_the_ear_owns_a_detector() -> None:
    package = Path(cgid.__file__).parent
    others = [path for path in package.rglob("*.py") if path.parent.name != "detection"]
    assert len(others) > 100
    assert [path.name for path in others if "ImpactDetector(" in path.read_text()] == []
