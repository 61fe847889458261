/* What the camera answers to commands: registers, CMOS registers, calibration parameters.
 *
 * A request is "GM", length in words, command, tag, arguments; a reply "RB" and the same, little-endian.
 */
#include "virtual_usb.h"

#include <string.h>

enum command {
    READ_REGISTER = 0x02,
    WRITE_REGISTER = 0x03,
    FIXED_PARAMETERS = 0x04,
    ALGORITHM_PARAMETERS = 0x16,
    CMOS_REGISTER = 0x95,
};

enum camera_register {
    VIDEO_STREAM = 0x05,     /* 0 off, 1 colour, 3 infrared */
    DEPTH_STREAM = 0x06,     /* 0 off, 2 depth */
    VIDEO_FORMAT = 0x0c,     /* 0 Bayer */
    VIDEO_RESOLUTION = 0x0d, /* 1 640x480, 2 1280x1024 */
    DEPTH_FORMAT = 0x12,     /* 3 11 bit */
    IR_FORMAT = 0x19,        /* 0 10 bit packed */
    IR_RESOLUTION = 0x1a,    /* 1 640x488, 2 1280x1024 */
};

#define HEADER 8
#define CMOS_WRITE 0x8000

/* Zero plane of a typical unit, all in cm: distance of the emitter and of the colour camera, distance
 * of the plane, size of a pixel on it; they stand at this offset in the fixed parameters. */
static const float ZERO_PLANE[4] = {7.5f, 2.3f, 120.0f, 0.1042f};
#define ZERO_PLANE_OFFSET 94
#define CONST_SHIFT 200

static unsigned get16(const uint8_t *bytes) { return bytes[0] | (unsigned)bytes[1] << 8; }

static void put16(uint8_t *bytes, unsigned value)
{
    bytes[0] = (uint8_t)value;
    bytes[1] = (uint8_t)(value >> 8);
}

/* A stream of a kind that this camera does not speak stays off. */
static void switch_video(struct kinect *kinect, unsigned value)
{
    const uint16_t *registers = kinect->registers;
    bool infrared = value == 3;
    unsigned format = registers[infrared ? IR_FORMAT : VIDEO_FORMAT];
    unsigned resolution = registers[infrared ? IR_RESOLUTION : VIDEO_RESOLUTION];
    stream_stop(kinect, VIDEO);
    if ((value == 1 || infrared) && format == 0 && (resolution == 1 || resolution == 2)) {
        enum image_kind medium = infrared ? IR : BAYER, high = infrared ? IR_HIGH : BAYER_HIGH;
        stream_start(kinect, VIDEO, resolution == 2 ? high : medium);
    }
}

static void switch_depth(struct kinect *kinect, unsigned value)
{
    stream_stop(kinect, DEPTH);
    if (value == 2 && kinect->registers[DEPTH_FORMAT] == 3)
        stream_start(kinect, DEPTH, DEPTH_11BIT);
}

static void write_register(struct kinect *kinect, unsigned address, unsigned value)
{
    kinect_log(kinect, "register %04x=%04x", address, value);
    kinect->registers[address % REGISTERS] = (uint16_t)value;
    if (address == VIDEO_STREAM)
        switch_video(kinect, value);
    if (address == DEPTH_STREAM)
        switch_depth(kinect, value);
}

static int cmos_register(struct kinect *kinect, const uint8_t *arguments, uint8_t *answer)
{
    unsigned address = get16(arguments + 2);
    uint16_t *cell = &kinect->cmos[address % REGISTERS];
    if (address & CMOS_WRITE) {
        *cell = (uint16_t)get16(arguments + 4);
        kinect_log(kinect, "cmos %04x=%04x", address & ~CMOS_WRITE, *cell);
    }
    put16(answer, 1);
    put16(answer + 2, address);
    put16(answer + 4, *cell);
    return 6;
}

static int algorithm_parameters(const uint8_t *arguments, uint8_t *answer)
{
    switch (get16(arguments)) {
    case 0x00:
        put16(answer + 2, CONST_SHIFT);
        return 4;
    case 0x40:
        return 118; /* registration polynomial: zeros register nothing and harm nothing */
    case 0x41:
        return 8; /* padding lines */
    default:
        return 2;
    }
}

static int fixed_parameters(const struct kinect *kinect, uint8_t *answer)
{
    memcpy(answer + ZERO_PLANE_OFFSET, ZERO_PLANE, sizeof ZERO_PLANE);
    return kinect->model == MODEL_1414 ? 322 : 334;
}

static int execute(struct kinect *kinect, unsigned command, const uint8_t *arguments, uint8_t *answer)
{
    switch (command) {
    case READ_REGISTER:
        put16(answer, get16(arguments));
        put16(answer + 2, kinect->registers[get16(arguments) % REGISTERS]);
        return 4;
    case WRITE_REGISTER:
        write_register(kinect, get16(arguments), get16(arguments + 2));
        return 2;
    case CMOS_REGISTER:
        return cmos_register(kinect, arguments, answer);
    case ALGORITHM_PARAMETERS:
        return algorithm_parameters(arguments, answer);
    case FIXED_PARAMETERS:
        return fixed_parameters(kinect, answer);
    default:
        kinect_log(kinect, "unknown command %04x", command);
        return 2;
    }
}

void camera_command(struct kinect *kinect, const uint8_t *request, int length)
{
    uint8_t arguments[16] = {0};
    uint8_t *reply = kinect->reply;
    if (length < HEADER)
        return;
    size_t given = (size_t)(length - HEADER);
    memcpy(arguments, request + HEADER, given < sizeof arguments ? given : sizeof arguments);
    memset(reply, 0, sizeof kinect->reply);
    int answered = execute(kinect, get16(request + 4), arguments, reply + HEADER);
    memcpy(reply, "RB", 2);
    put16(reply + 2, (unsigned)answered / 2);
    memcpy(reply + 4, request + 4, 4); /* command and tag come back */
    kinect->reply_length = HEADER + answered;
    if (kinect->faults.deaf_sensor && get16(request + 4) == CMOS_REGISTER)
        reply[4] ^= 0xff; /* the answer to no command */
}

/* The reply to the last command, once; 0 bytes when there is none. */
int camera_reply(struct kinect *kinect, uint8_t *data, int size)
{
    int length = kinect->reply_length < size ? kinect->reply_length : size;
    memcpy(data, kinect->reply, (size_t)length);
    kinect->reply_length = 0;
    return length;
}
