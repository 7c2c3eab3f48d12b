"""What a process holds besides memory, one file for each kind. `kinds` lists them, `survey` asks all of them."""
