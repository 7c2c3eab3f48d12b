/* Files of a board, mapped and locked (the second argument is their directory): after a restore each mapping holds zeros, is private,
 * and keeps its protection; each descriptor leads to /dev/null. With "over", other memory is where they are mapped until the file
 * "map" is there. */
#include "tracee.h"

#include <sys/file.h>

enum { PAGES = 6 };

static unsigned char *places[3];

static unsigned char *mapped(const char *directory, const char *name, int writable, int *file) {
    static int number;
    char path[600];
    snprintf(path, sizeof path, "%s/%s", directory, name);
    *file = open(path, (writable ? O_RDWR : O_RDONLY) | O_CLOEXEC);
    if (*file < 0) cannot("open %s", path);
    unsigned char *wanted = places[number++];
    int protection = PROT_READ | (writable ? PROT_WRITE : 0);
    void *place = mmap(wanted, PAGES * PAGE, protection, MAP_SHARED | (wanted ? MAP_FIXED : 0), *file, 0);
    if (place == MAP_FAILED) cannot("map %s", path);
    return place;
}

static void lock_byte(int file, off_t byte) {
    struct flock lock = {.l_type = F_WRLCK, .l_whence = SEEK_SET, .l_start = byte, .l_len = 1};
    if (fcntl(file, F_OFD_SETLK, &lock) != 0) cannot("lock");
}

static void expect_harmless(const char *what, int file) {
    struct stat about;
    if (fstat(file, &about) != 0) differs("%s: its descriptor is closed", what);
    else EXPECT(S_ISCHR(about.st_mode) && about.st_rdev == 0x103, "%s: its descriptor is of device %lx", what, (long)about.st_rdev);
    EXPECT_EQUAL("close-on-exec", fcntl(file, F_GETFD), FD_CLOEXEC);
}

int main(int count, char **arguments) {
    int files[4];
    if (count < 3) return 2;
    for (int index = 0; count > 3 && index < 3; index++)
        fill(places[index] = map_pages(PAGES, PROT_READ | PROT_WRITE, 0), PAGES * PAGE, 1);
    if (count > 3) ready(), wait_for_go("map");
    unsigned char *own = mapped(arguments[2], "own", 1, &files[0]), *mine = mapped(arguments[2], "own+1000", 1, &files[1]);
    unsigned char *peer = mapped(arguments[2], "peer-robot2", 0, &files[2]);
    files[3] = dup(files[0]);
    fcntl(files[3], F_SETFD, FD_CLOEXEC);
    lock_byte(files[0], (off_t)1 << 40);
    lock_byte(files[0], ((off_t)1 << 41) + 5);
    if (flock(files[1], LOCK_SH) != 0) cannot("flock");
    puts(count > 3 ? "mapped" : "ready");
    fflush(stdout);
    wait_for_go(arguments[1]);
    expect_zero("own", own, PAGES * PAGE);
    expect_zero("own+1000", mine, PAGES * PAGE);
    expect_zero("peer", peer, PAGES * PAGE);
    EXPECT(strcmp(permissions_at(own), "rw-p") == 0, "own is mapped %s", permissions_at(own));
    EXPECT(strcmp(permissions_at(peer), "r--p") == 0, "peer is mapped %s", permissions_at(peer));
    memset(own, 'x', PAGES * PAGE);
    for (int index = 0; index < 4; index++) expect_harmless("file", files[index]);
    return finish();
}
