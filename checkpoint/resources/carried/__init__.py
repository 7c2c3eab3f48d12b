"""Files that travel with a program (rule ``carry``): captured, laid down at the other robot, their owners and modes."""
