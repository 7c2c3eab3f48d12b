/* Gives each line of standard input to the sketch's parser, in memory of exactly its size, so that a sanitizer sees a byte too far. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "../../examples/arduino/command.h"

int main(void)
{
    char *held = NULL;
    size_t room = 0;
    ssize_t size;

    while ((size = getline(&held, &room, stdin)) > 0) {
        size -= held[size - 1] == '\n';
        if (size > LINE_SIZE_MAX) {
            puts("too long");
            continue;
        }
        char *exact = malloc(size ? (size_t)size : 1);
        memcpy(exact, held, (size_t)size);
        struct command command = parse_command(exact, (uint16_t)size);
        free(exact);
        if (command.error != NULL)
            puts(command.at <= size ? "refused" : "an error behind the end");
        else
            printf("%s %d %ld\n", command.verb == VERB_SET ? "set" : "read", command.duty, (long)command.id);
    }
    free(held);
    return 0;
}
