"""Files that travel with a program (rule ``carry``): capture them, restore them on the other robot, set owners and modes."""
