"""Files that a process has open or mapped: regular and deleted ones, memfd, locks, /proc and /sys, namespaces."""
