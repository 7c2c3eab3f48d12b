"""The process that copies checkpoints to an archive, at a low priority. Only the worker starts it and talks to it."""
