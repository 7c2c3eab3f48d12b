"""Files that a process has open or mapped: regular and deleted files, memfd, locks, /proc and /sys, namespaces."""
