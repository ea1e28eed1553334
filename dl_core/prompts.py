"""The paper's prompts.

Source: DiffusionLight, Sec. 4 (prompt) and Sec. 4.2 (dark prompt); the negative prompt is that of the authors' code.
"""

from __future__ import annotations

from typing import Final

__all__ = ["DARK_PROMPT", "NEGATIVE_PROMPT", "PROMPT"]

PROMPT: Final = "a perfect mirrored reflective chrome ball sphere"
DARK_PROMPT: Final = "a perfect black dark mirrored reflective chrome ball sphere"
NEGATIVE_PROMPT: Final = "matte, diffuse, flat, dull"
