/* A motor behind a pulse width modulator: a line of JSON comes, a line of JSON goes.
 *
 *     {"verb":"set","duty":0.4,"id":7}   {"id":7,"ok":{"duty":0.4000,"pwm":102,"moves":1}}
 *     {"verb":"read","id":8}             {"id":8,"ok":{"duty":0.4000,"pwm":102,"moves":1}}
 *     {"verb":"fly","id":9}              {"id":9,"error":"unknown verb: there are set and read","at":13}
 *
 * Each line is answered by one line, in order. A sender that waits for the answer before it sends the next line never overflows
 * the 64 bytes that the Arduino buffers while a command is carried out. A line may be sent again when no answer came: with the
 * same id and the same duty it moves nothing. examples/arduino/host/ runs this file on a PC.
 */
#include <Arduino.h>
#include <stdio.h>

#include "command.h"

static const uint8_t PWM_PIN = 9;
static const uint8_t BACKWARDS_PIN = 8;
static const long BAUD = 115200;

static char line[LINE_SIZE_MAX];
static uint16_t line_size;
static bool is_too_long;

static int16_t duty; /* of DUTY_ONE */
static int pwm;      /* 0 to 255 */
static unsigned long moves;
static int32_t moved_by = NO_ID;

static void move_to(int16_t wanted, int32_t id)
{
    bool is_repeated = id != NO_ID && id == moved_by && wanted == duty;

    if (is_repeated)
        return;
    duty = wanted;
    pwm = (int)(((wanted < 0 ? -(long)wanted : (long)wanted) * 255 + DUTY_ONE / 2) / DUTY_ONE);
    digitalWrite(BACKWARDS_PIN, wanted < 0 ? HIGH : LOW);
    analogWrite(PWM_PIN, pwm);
    moves++;
    moved_by = id;
}

static void answer(const struct command *command)
{
    char id[16] = "null", text[160];
    int positive = duty < 0 ? -duty : duty, size;

    if (command->id != NO_ID)
        snprintf(id, sizeof id, "%ld", (long)command->id);
    if (command->error != NULL)
        size = snprintf(text, sizeof text, "{\"id\":%s,\"error\":\"%s\",\"at\":%u}\n", id, command->error, command->at);
    else
        size = snprintf(text, sizeof text, "{\"id\":%s,\"ok\":{\"duty\":%s%d.%04d,\"pwm\":%d,\"moves\":%lu}}\n", id,
                        duty < 0 ? "-" : "", positive / DUTY_ONE, positive % DUTY_ONE, pwm, moves);
    Serial.write(text, (size_t)size);
}

static void obey(void)
{
    struct command command = {VERB_NONE, NO_ID, 0, "the line is longer than 256 bytes", LINE_SIZE_MAX};

    if (!is_too_long)
        command = parse_command(line, line_size);
    if (command.error == NULL && command.verb == VERB_SET)
        move_to(command.duty, command.id);
    answer(&command);
}

void setup(void)
{
    pinMode(PWM_PIN, OUTPUT);
    pinMode(BACKWARDS_PIN, OUTPUT);
    Serial.begin(BAUD);
}

void loop(void)
{
    while (Serial.available() > 0) {
        char letter = (char)Serial.read();
        if (letter == '\n') {
            obey();
            line_size = 0;
            is_too_long = false;
        } else if (line_size < LINE_SIZE_MAX) {
            line[line_size++] = letter;
        } else {
            is_too_long = true;
        }
    }
}
