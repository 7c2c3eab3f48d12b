"""The worker process, for all slow work: snapshots, programs, users' requests. It starts at `process` or `witness`.

`board_directory` makes the files of this robot's board; the main loop moves the items (`agent.main_loop.board_link`).
"""
