"""Descriptors that tell of events: epoll, eventfd, inotify, pidfd, signalfd, timerfd; asynchronous I/O."""
