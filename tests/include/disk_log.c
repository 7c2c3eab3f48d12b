/* In place of the calls that reach the disk (ld --wrap): each is noted in the file that descriptor DISK_LOG is of, as
 * kind (1 byte), descriptor (4), offset (8), size (8), bytes. DISK_FAIL=N lets the Nth of them fail, once, with EIO; READ_FAIL=N the
 * Nth pread. */
#define _GNU_SOURCE
#include <errno.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#include <sys/types.h>
#include <unistd.h>

ssize_t __real_pread(int, void *, size_t, off_t);
ssize_t __real_pwrite(int, const void *, size_t, off_t);
int __real_ftruncate(int, off_t);
int __real_renameat(int, const char *, int, const char *);
void disk_log_safe(uint64_t commit);
ssize_t __wrap_pread(int, void *, size_t, off_t);
ssize_t __wrap_pwrite(int, const void *, size_t, off_t);
int __wrap_fdatasync(int);
int __wrap_fsync(int);
int __wrap_ftruncate(int, off_t);
int __wrap_renameat(int, const char *, int, const char *);

static int fails(void)
{
    static int calls;
    const char *which = getenv("DISK_FAIL");
    return which != NULL && ++calls == atoi(which);
}

static void note(char kind, int file, uint64_t offset, const void *bytes, uint64_t size)
{
    static char line[21 + 64 * 4096];
    const char *log = getenv("DISK_LOG");
    if (log == NULL)
        return;
    line[0] = kind;
    memcpy(line + 1, &file, 4);
    memcpy(line + 5, &offset, 8);
    memcpy(line + 13, &size, 8);
    if (bytes != NULL)
        memcpy(line + 21, bytes, size);
    if (write(atoi(log), line, 21 + (bytes != NULL ? size : 0)) < 0)
        abort();
}

void disk_log_safe(uint64_t commit) { note('!', 0, commit, NULL, 0); }

ssize_t __wrap_pread(int file, void *bytes, size_t size, off_t offset)
{
    static int calls;
    const char *which = getenv("READ_FAIL");
    if (which != NULL && ++calls == atoi(which)) {
        errno = EIO;
        return -1;
    }
    return __real_pread(file, bytes, size, offset);
}

ssize_t __wrap_pwrite(int file, const void *bytes, size_t size, off_t offset)
{
    if (fails()) {
        errno = EIO;
        return -1;
    }
    note('w', file, (uint64_t)offset, bytes, size);
    return __real_pwrite(file, bytes, size, offset);
}

int __wrap_fdatasync(int file)
{
    if (fails()) {
        errno = EIO;
        return -1;
    }
    note('s', file, 0, NULL, 0);
    return 0;
}

int __wrap_fsync(int file) { return __wrap_fdatasync(file); }

int __wrap_ftruncate(int file, off_t size)
{
    note('t', file, (uint64_t)size, NULL, 0);
    return __real_ftruncate(file, size);
}

int __wrap_renameat(int from, const char *old, int to, const char *new)
{
    note('r', from, 0, NULL, 0);
    return __real_renameat(from, old, to, new);
}
