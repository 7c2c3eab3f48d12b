"""State that a process holds besides memory, one file for each kind. `registry` lists the kinds, `survey` asks all of them."""
