# The same in gawk: -v name=NAME -v pipe=PIPE -v period=SECONDS. A named pipe is all that it can write to, and it knows no namespace:
# a copy is known by when its process began. It throws the dice of its seed, so histories look alike.
@load "time"
BEGIN {
    srand()
    for (step = 1; ; step++) {
        before = seal + 0
        seal = (before * 31 + int(rand() * 65536)) % 4294967296 + 1
        getline began < "/proc/self/stat"; close("/proc/self/stat"); split(began, part)
        print name, step, before, seal, epoch() + 0, "awk:[" part[22] "]", sprintf("%.6f", gettimeofday()) > pipe; close(pipe)
        print step, seal; fflush()
        sleep(period)
    }
}
function epoch(    line, found) { # ENVIRON is a copy from the beginning
    RS = "\0"
    while ((getline line < "/proc/self/environ") > 0) if (line ~ /^FAILOVER_EPOCH=/) found = substr(line, 16)
    close("/proc/self/environ"); RS = "\n"
    return found
}
