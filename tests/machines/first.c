/* The first program of an emulated machine: loads modules in order, mounts the disk, goes on as the disk's own init. */
#define _GNU_SOURCE
#include <fcntl.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/mount.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <unistd.h>

static void need(int failed, const char *what) {
    if (!failed) return;
    perror(what);
    sleep(5); /* for the console to be written out */
    exit(1);  /* the kernel panics, and the emulator ends */
}

int main(void) {
    mkdir("/dev", 0755);
    mkdir("/disk", 0755);
    need(mount("devtmpfs", "/dev", "devtmpfs", 0, NULL), "mount /dev");
    char path[16];
    for (int number = 0;; number++) { /* "0.ko", "1.ko" … in the order in which they need each other */
        snprintf(path, sizeof path, "/%d.ko", number);
        int module = open(path, O_RDONLY | O_CLOEXEC);
        if (module < 0) break;
        need((int)syscall(SYS_finit_module, module, "", 0), path);
        close(module);
    }
    int tries = 300;
    while (access("/dev/vda", F_OK) && tries--) usleep(100000);
    need(mount("/dev/vda", "/disk", "ext4", 0, NULL), "mount /dev/vda");
    need(mount("/dev", "/disk/dev", NULL, MS_MOVE, NULL), "move /dev");
    need(chdir("/disk") || mount(".", "/", NULL, MS_MOVE, NULL) || chroot(".") || chdir("/"), "change the root directory");
    execl("/sbin/init", "init", (char *)NULL);
    need(1, "execute /sbin/init");
}
