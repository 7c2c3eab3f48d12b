"""The board, the robots and the drivers for programs of other middlewares: a process of its own, one module for each."""
