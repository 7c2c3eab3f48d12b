/* An ordinary user's program that belongs to a login; the second argument is the user of that, the third its own. */
#include "tracee.h"

#include <grp.h>

static long login(void) {
    char text[16] = "";
    int file = open("/proc/self/loginuid", O_RDONLY | O_CLOEXEC);
    if (file < 0 || read(file, text, sizeof text - 1) < 0) cannot("read whose login it is");
    close(file);
    return atol(text);
}

int main(int count, char **arguments) {
    if (count < 4) cannot("go on without users");
    int file = open("/proc/self/loginuid", O_WRONLY | O_CLOEXEC), user = atoi(arguments[3]);
    if (file < 0 || write(file, arguments[2], strlen(arguments[2])) < 0) cannot("say whose login it is");
    close(file);
    if (setgroups(0, NULL) || setresgid(user, user, user) || setresuid(user, user, user)) cannot("become a user");
    ready();
    wait_for_go(arguments[1]);
    EXPECT_EQUAL("user of the login", login(), atol(arguments[2]));
    EXPECT_EQUAL("its user", getuid(), user);
    return finish();
}
