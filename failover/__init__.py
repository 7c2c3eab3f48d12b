"""Rules and faces: who runs what, and how people and programs ask."""
