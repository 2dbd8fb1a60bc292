"""Write docs/parameters.md from the components' dataclasses: ``python docs/make_parameters.py``."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path
from typing import Any

# The sources of this checkout, not an installed package.
sys.path[:0] = [str(Path(__file__).resolve().parents[1])]

from drocap_ros.config import DrocapConfig, section_types  # noqa: E402

HEADER = """# Parameters

`python docs/make_parameters.py` writes this page from the components' dataclasses, which are also the source of the ROS
parameter declarations and of the YAML loader. A configuration file has the form of a ROS 2 parameter file:

```yaml
/**/pose_estimator:
  ros__parameters:
    threads: 2
```
"""


def render() -> str:
    """The whole page."""
    parts = [HEADER]
    defaults = DrocapConfig()
    for component, kind in section_types().items():
        first = (kind.__doc__ or "").strip().splitlines()[0]
        parts.append(f"\n## {component}\n\n{first}\n\n| parameter | default | range | meaning |\n|---|---|---|---|\n")
        for spec in dataclasses.fields(kind):
            meta = spec.metadata
            unit = f" {meta['unit']}" if meta["unit"] else ""
            default = getattr(defaults.section(component), spec.name)
            shown = f"`{default!r}`{unit}" if default != "" else "empty"
            meaning = meta["description"].replace("|", "\\|")
            parts.append(f"| `{spec.name}` | {shown} | {_range(meta)} | {meaning} |\n")
    return "".join(parts)


def _range(meta: Any) -> str:
    if meta["choices"]:
        return ", ".join(meta["choices"])
    low, high = meta["minimum"], meta["maximum"]
    if low is None and high is None:
        return ""
    if low is None or high is None:
        return f"<= {high:g}" if low is None else f">= {low:g}"
    return f"{low:g} to {high:g}"


if __name__ == "__main__":
    (Path(__file__).parent / "parameters.md").write_text(render(), encoding="utf-8")
