"""Components of this robot: started, captured, restored, kept ready, ended."""
