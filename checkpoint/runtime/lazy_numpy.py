"""Import numpy at its first use: an agent that holds no snapshot yet saves its 8 MB.

A name imported from here costs nothing more after its first use. A process that handles pages in any case (the keeper) imports
numpy directly.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray
else:

    class _Later:
        """Stands for the module; each name is looked up in it once."""

        def __getattr__(self, name: str) -> Any:
            import numpy

            found = getattr(numpy, name)
            setattr(self, name, found)
            return found

    np = _Later()
    NDArray = ()
    """For annotations, which are not evaluated."""

__all__ = ["NDArray", "np"]
