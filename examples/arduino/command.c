#include "command.h"

#include <stdbool.h>
#include <stddef.h>
#include <string.h>

#define WORD_SIZE_MAX 8   /* longer than each word that is known */
#define DIGITS_MAX 9      /* as many as 32 bits always hold */
#define EXPONENT_MAX 1000 /* far beyond what the other digits of a line can make good */
#define UNKNOWN_LETTER 0xFF

struct reader {
    const char *begin, *at, *end;
    const char *error; /* the line is no JSON */
};

struct word {
    char text[WORD_SIZE_MAX];
    uint16_t size; /* above WORD_SIZE_MAX: it is too long to be known */
};

struct number { /* digits × 10^exponent */
    uint32_t digits;
    int16_t exponent;
    bool is_negative;
    bool is_cut; /* a digit other than 0 did not fit */
};

enum { SEEN_VERB = 1, SEEN_DUTY = 2, SEEN_ID = 4 };

struct fields {
    struct command command;
    uint8_t seen;
};

static bool skip_value(struct reader *reader, uint8_t depth);

static bool fail(struct reader *reader, const char *why)
{
    reader->error = why;
    return false;
}

static int peek(const struct reader *reader)
{
    return reader->at < reader->end ? (unsigned char)*reader->at : -1;
}

static int next_token(struct reader *reader)
{
    while (reader->at < reader->end && strchr(" \t\r\n", *reader->at) != NULL && *reader->at != '\0')
        reader->at++;
    return peek(reader);
}

static bool take(struct reader *reader, char wanted)
{
    if (next_token(reader) != wanted)
        return false;
    reader->at++;
    return true;
}

static bool expect(struct reader *reader, char wanted)
{
    return take(reader, wanted) || fail(reader, "not JSON");
}

/* --- Strings ------------------------------------------------------------------------------------------------------ */

static int hexadecimal(int letter)
{
    if (letter >= '0' && letter <= '9')
        return letter - '0';
    if (letter >= 'a' && letter <= 'f')
        return letter - 'a' + 10;
    return letter >= 'A' && letter <= 'F' ? letter - 'A' + 10 : -1;
}

/* Which letter is meant by what follows a backslash; -1: none. */
static int escaped(struct reader *reader)
{
    static const char letters[] = "\"\\/bfnrt", meant[] = "\"\\/\b\f\n\r\t";
    int letter = peek(reader), i;
    uint16_t code = 0;

    if (letter <= 0)
        return -1;
    if (letter != 'u') {
        const char *found = strchr(letters, letter);
        if (found == NULL)
            return -1;
        reader->at++;
        return meant[found - letters];
    }
    reader->at++;
    for (i = 0; i < 4; i++) {
        int digit = hexadecimal(peek(reader));
        if (digit < 0)
            return -1;
        code = (uint16_t)((code & 0xFFFU) << 4 | (unsigned)digit);
        reader->at++;
    }
    return code < 0x80 ? code : UNKNOWN_LETTER;
}

static bool read_string(struct reader *reader, struct word *into)
{
    if (!expect(reader, '"'))
        return false;
    into->size = 0;
    while (reader->at < reader->end) {
        int letter = peek(reader);
        if (letter < 0x20)
            return fail(reader, "control character in a string");
        reader->at++;
        if (letter == '"')
            return true;
        if (letter == '\\' && (letter = escaped(reader)) < 0)
            return fail(reader, "not JSON");
        if (into->size < WORD_SIZE_MAX)
            into->text[into->size] = (char)letter;
        if (into->size <= WORD_SIZE_MAX)
            into->size++;
    }
    return fail(reader, "a string does not end");
}

static bool is(const struct word *word, const char *known)
{
    return word->size == strlen(known) && memcmp(word->text, known, word->size) == 0;
}

/* --- Numbers ------------------------------------------------------------------------------------------------------ */

static bool is_digit(int letter)
{
    return letter >= '0' && letter <= '9';
}

/* A row of digits before (`shift` 0) or after (-1) the point. */
static bool read_digits(struct reader *reader, struct number *into, int shift)
{
    const uint32_t full = 100000000; /* 10^(DIGITS_MAX - 1) */

    if (!is_digit(peek(reader)))
        return fail(reader, "not JSON");
    for (; is_digit(peek(reader)); reader->at++) {
        uint8_t digit = (uint8_t)(peek(reader) - '0');
        if (into->digits < full) {
            into->digits = into->digits * 10 + digit;
            into->exponent = (int16_t)(into->exponent + shift);
        } else {
            into->is_cut |= digit != 0;
            into->exponent = (int16_t)(into->exponent + shift + 1);
        }
    }
    return true;
}

static bool read_exponent(struct reader *reader, struct number *into)
{
    bool is_negative = peek(reader) == '-';
    int16_t exponent = 0;

    if (is_negative || peek(reader) == '+')
        reader->at++;
    if (!is_digit(peek(reader)))
        return fail(reader, "not JSON");
    for (; is_digit(peek(reader)); reader->at++)
        if (exponent < EXPONENT_MAX)
            exponent = (int16_t)(exponent * 10 + peek(reader) - '0');
    into->exponent = (int16_t)(into->exponent + (is_negative ? -exponent : exponent));
    return true;
}

static bool read_number(struct reader *reader, struct number *into)
{
    memset(into, 0, sizeof *into);
    into->is_negative = take(reader, '-');
    if (peek(reader) == '0')
        reader->at++;
    else if (!read_digits(reader, into, 0))
        return false;
    if (peek(reader) == '.') {
        reader->at++;
        if (!read_digits(reader, into, -1))
            return false;
    }
    if (peek(reader) == 'e' || peek(reader) == 'E') {
        reader->at++;
        return read_exponent(reader, into);
    }
    return true;
}

/* |number| × 10^places, cut off; false: it is above the limit. `is_whole`: nothing was cut off. */
static bool scaled(const struct number *number, int places, uint32_t limit, uint32_t *value, bool *is_whole)
{
    int exponent = number->exponent + places;

    *value = number->digits;
    *is_whole = !number->is_cut;
    for (; exponent > 0 && *value > 0; exponent--) {
        if (*value > limit / 10)
            return false;
        *value *= 10;
    }
    for (; exponent < 0 && *value > 0; exponent++) {
        *is_whole &= *value % 10 == 0;
        *value /= 10;
    }
    return *value < limit || (*value == limit && *is_whole);
}

/* --- Tables and lists that are ignored ---------------------------------------------------------------------------- */

static bool skip_word(struct reader *reader, const char *word)
{
    size_t size = strlen(word);

    if ((size_t)(reader->end - reader->at) < size || memcmp(reader->at, word, size) != 0)
        return fail(reader, "not JSON");
    reader->at += size;
    return true;
}

static bool skip_list(struct reader *reader, uint8_t depth)
{
    if (!expect(reader, '['))
        return false;
    if (take(reader, ']'))
        return true;
    do {
        if (!skip_value(reader, depth))
            return false;
    } while (take(reader, ','));
    return expect(reader, ']');
}

static bool skip_table(struct reader *reader, uint8_t depth)
{
    struct word ignored;

    if (!expect(reader, '{'))
        return false;
    if (take(reader, '}'))
        return true;
    do {
        if (!read_string(reader, &ignored) || !expect(reader, ':') || !skip_value(reader, depth))
            return false;
    } while (take(reader, ','));
    return expect(reader, '}');
}

/* A value inside so many tables and lists. */
static bool skip_value(struct reader *reader, uint8_t depth)
{
    struct word word;
    struct number number;
    int first = next_token(reader);

    if ((first == '{' || first == '[') && depth >= DEPTH_MAX)
        return fail(reader, "too many tables and lists inside each other");
    switch (first) {
    case '"': return read_string(reader, &word);
    case '{': return skip_table(reader, depth + 1);
    case '[': return skip_list(reader, depth + 1);
    case 't': return skip_word(reader, "true");
    case 'f': return skip_word(reader, "false");
    case 'n': return skip_word(reader, "null");
    default: return read_number(reader, &number);
    }
}

/* --- The fields that are known ------------------------------------------------------------------------------------ */

/* JSON, and yet no command: reading goes on, so that the answer can name the id. The first error stays. */
static bool refuse(const struct reader *reader, struct fields *fields, const char *why)
{
    if (fields->command.error == NULL) {
        fields->command.error = why;
        fields->command.at = (uint16_t)(reader->at - reader->begin);
    }
    return true;
}

static bool read_verb(struct reader *reader, struct fields *into)
{
    struct word word;

    if (next_token(reader) != '"')
        return refuse(reader, into, "verb is no string") && skip_value(reader, 1);
    if (!read_string(reader, &word))
        return false;
    into->command.verb = is(&word, "set") ? VERB_SET : is(&word, "read") ? VERB_READ : VERB_NONE;
    return into->command.verb != VERB_NONE || refuse(reader, into, "unknown verb: there are set and read");
}

static bool starts_number(struct reader *reader)
{
    int first = next_token(reader);
    return first == '-' || is_digit(first);
}

static bool read_duty(struct reader *reader, struct fields *into)
{
    struct number number;
    uint32_t value;
    bool is_whole;

    if (!starts_number(reader))
        return refuse(reader, into, "duty is no number") && skip_value(reader, 1);
    if (!read_number(reader, &number))
        return false;
    if (!scaled(&number, 4, DUTY_ONE, &value, &is_whole))
        return refuse(reader, into, "duty is not from -1 to 1");
    into->command.duty = (int16_t)(number.is_negative ? -(int32_t)value : (int32_t)value);
    return true;
}

static bool read_id(struct reader *reader, struct fields *into)
{
    struct number number;
    uint32_t value;
    bool is_whole;

    if (!starts_number(reader))
        return refuse(reader, into, "id is no number") && skip_value(reader, 1);
    if (!read_number(reader, &number))
        return false;
    if (!scaled(&number, 0, ID_MAX, &value, &is_whole) || !is_whole || (number.is_negative && value > 0))
        return refuse(reader, into, "id is no whole number from 0 to 999999999");
    into->command.id = (int32_t)value;
    return true;
}

static bool read_field(struct reader *reader, struct fields *into)
{
    static const struct {
        const char *name;
        uint8_t bit;
        bool (*read)(struct reader *, struct fields *);
    } known[] = {{"verb", SEEN_VERB, read_verb}, {"duty", SEEN_DUTY, read_duty}, {"id", SEEN_ID, read_id}};
    struct word key;
    uint8_t i;

    if (!read_string(reader, &key) || !expect(reader, ':'))
        return false;
    for (i = 0; i < sizeof known / sizeof *known; i++) {
        if (!is(&key, known[i].name))
            continue;
        if (into->seen & known[i].bit)
            return refuse(reader, into, "a field is there twice") && skip_value(reader, 1);
        into->seen |= known[i].bit;
        return known[i].read(reader, into);
    }
    return skip_value(reader, 1);
}

static bool read_line(struct reader *reader, struct fields *into)
{
    if (!expect(reader, '{'))
        return false;
    if (!take(reader, '}')) {
        do {
            if (!read_field(reader, into))
                return false;
        } while (take(reader, ','));
        if (!expect(reader, '}'))
            return false;
    }
    return next_token(reader) < 0 || fail(reader, "more follows after the table");
}

struct command parse_command(const char *line, uint16_t size)
{
    struct reader reader = {line, line, line + size, NULL};
    struct fields fields = {{VERB_NONE, NO_ID, 0, NULL, 0}, 0};

    if (!read_line(&reader, &fields)) {
        fields.command.error = reader.error;
        fields.command.at = (uint16_t)(reader.at - reader.begin);
        fields.command.id = NO_ID;
    } else if (!(fields.seen & SEEN_VERB)) {
        refuse(&reader, &fields, "verb is missing");
    } else if (fields.command.verb == VERB_SET && !(fields.seen & SEEN_DUTY)) {
        refuse(&reader, &fields, "duty is missing");
    }
    return fields.command;
}
