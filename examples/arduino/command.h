/* A line of JSON from the serial port as a command: {"verb":"set","duty":0.4,"id":7}
 *
 * Fields come in any order; unknown ones may hold anything and are ignored. Nothing is allocated, nothing is written outside
 * the structures of the caller, and nothing beyond `size` bytes is read. Numbers are whole: a duty of 1 is DUTY_ONE.
 */
#ifndef COMMAND_H
#define COMMAND_H

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

#define LINE_SIZE_MAX 256 /* bytes, without the end of the line */
#define DEPTH_MAX 8       /* tables and lists inside each other: each takes some bytes of the stack */
#define DUTY_ONE 10000
#define ID_MAX 999999999
#define NO_ID (-1)

enum verb { VERB_NONE, VERB_SET, VERB_READ };

struct command {
    enum verb verb;
    int32_t id;   /* 0 to ID_MAX; NO_ID: the line names none, or is no JSON */
    int16_t duty; /* -DUTY_ONE to DUTY_ONE, what is smaller is cut off; of VERB_SET */
    const char *error; /* a sentence without quotation marks; NULL: the command can be carried out */
    uint16_t at;       /* the byte where the error was seen */
};

struct command parse_command(const char *line, uint16_t size);

#ifdef __cplusplus
}
#endif

#endif
