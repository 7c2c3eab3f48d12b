"""Descriptors that report events: epoll, eventfd, inotify, pidfd, signalfd, timerfd; asynchronous I/O."""
