/* Says where in the C library lie the functions that it has chosen by the processor's features, one a line. */
#include "tracee.h"

#include <dlfcn.h>

int main(int count, char **arguments) {
    static const char *const names[] = {"memcpy", "memmove", "memset", "memchr", "memcmp", "strlen", "strchr",
                                        "strcmp", "strcpy", "strrchr", "strnlen", "rawmemchr"};
    (void)count;
    for (size_t index = 0; index < sizeof names / sizeof *names; index++) {
        char *function = dlsym(RTLD_DEFAULT, names[index]);
        Dl_info about;
        if (!function || !dladdr(function, &about)) cannot("find %s", names[index]);
        printf("%s %s %#lx\n", names[index], about.dli_fname, (unsigned long)(function - (char *)about.dli_fbase));
    }
    ready();
    wait_for_go(arguments[1]);
    return finish();
}
