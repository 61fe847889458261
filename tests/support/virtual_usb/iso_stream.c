/* Which packet of which frame crosses the bus in which microframe.
 *
 * Both streams share the device's frame grid, so that colour and depth of one frame number belong
 * together. The packets of a frame fill the first 30.4 ms of its interval: depth one in every
 * microframe, colour two in every three. A large image takes one packet in every microframe, and so
 * several intervals.
 */
#include "virtual_usb.h"

#include <string.h>

#define PACKET_HEADER 12
#define TICKS_PER_SLOT 7500 /* 60 MHz times 125 us */
#define RANDOM_RANGE 16777216u

struct layout {
    size_t frame_bytes;
    int payload;  /* bytes of a full packet */
    int packets;  /* of a frame */
    uint8_t flag; /* marks the stream in each packet's header */
    int intervals; /* of the bus' frame rate */
    int packets_in_group, slots_in_group;
};

static const struct layout LAYOUTS[IMAGE_KINDS] = {
    [BAYER] = {640 * 480, 1908, 162, 0x80, 1, 2, 3},
    [BAYER_HIGH] = {1280 * 1024, 1908, 687, 0x80, 3, 1, 1},
    [IR] = {640 * 488 * 10 / 8, 1908, 205, 0x80, 1, 1, 1},
    [IR_HIGH] = {1280 * 1024 * 10 / 8, 1908, 859, 0x80, 4, 1, 1},
    [DEPTH_11BIT] = {640 * 480 * 11 / 8, 1748, 242, 0x70, 1, 1, 1},
};

size_t image_bytes(enum image_kind kind) { return LAYOUTS[kind].frame_bytes; }

void stream_start(struct kinect *kinect, enum stream_id id, enum image_kind kind)
{
    struct stream *stream = &kinect->streams[id];
    stream->on = true;
    stream->kind = kind;
    stream->on_since_slot = kinect_slot(kinect);
}

void stream_stop(struct kinect *kinect, enum stream_id id) { kinect->streams[id].on = false; }

static int64_t first_slot(int64_t frame_ns, int64_t frame) { return (frame * frame_ns + SLOT_NS - 1) / SLOT_NS; }

static int64_t frame_at(int64_t frame_ns, int64_t slot)
{
    int64_t frame = slot * SLOT_NS / frame_ns;
    return first_slot(frame_ns, frame) > slot ? frame - 1 : frame;
}

/* The packet of a frame that starts `slot` microframes into it, or -1. */
static int packet_in_slot(const struct layout *layout, int64_t slot)
{
    int64_t group = slot / layout->slots_in_group;
    int64_t place = slot % layout->slots_in_group;
    int64_t packet = group * layout->packets_in_group + place;
    return place < layout->packets_in_group && packet < layout->packets ? (int)packet : -1;
}

static bool lost(struct kinect *kinect, enum stream_id id, int64_t frame, int packet)
{
    const struct faults *faults = &kinect->faults;
    kinect->random = kinect->random * 1664525u + 1013904223u; /* Numerical Recipes' generator */
    if ((kinect->random >> 8) < faults->lose_percent / 100 * RANDOM_RANGE)
        return true;
    int every = faults->lose_every[id];
    return packet == faults->lose_packet[id] && every > 0 && frame % every == 0;
}

static void put_header(uint8_t *header, uint8_t flag, uint8_t sequence, uint32_t ticks)
{
    const uint8_t bytes[PACKET_HEADER] = {
        'R', 'B', 0, flag, 0, sequence, 0, 0,
        (uint8_t)ticks, (uint8_t)(ticks >> 8), (uint8_t)(ticks >> 16), (uint8_t)(ticks >> 24),
    };
    memcpy(header, bytes, PACKET_HEADER);
}

/* Write the packet that crosses the bus in this microframe; its length, or 0 for an empty one. */
int stream_packet(struct kinect *kinect, enum stream_id id, int64_t slot, uint8_t *packet, int size)
{
    const struct stream *stream = &kinect->streams[id];
    const struct layout *layout = &LAYOUTS[stream->kind];
    const struct frame_file *file = &kinect->frames[stream->kind];
    int64_t frame_ns = kinect->bus->frame_ns * layout->intervals;
    int64_t frame = frame_at(frame_ns, slot);
    int64_t frame_slot = first_slot(frame_ns, frame);
    int number = packet_in_slot(layout, slot - frame_slot);
    if (!stream->on || frame_slot < stream->on_since_slot || number < 0 || !file->frames)
        return 0;
    bool last = number == layout->packets - 1;
    int length = last ? (int)layout->frame_bytes - number * layout->payload : layout->payload;
    if (kinect->faults.stall || lost(kinect, id, frame, number) || length + PACKET_HEADER > size)
        return 0;
    uint8_t flag = layout->flag | (number == 0 ? 1 : last ? 5 : 2);
    uint32_t ticks = kinect->first_tick + (uint32_t)((slot + 1) * TICKS_PER_SLOT);
    const uint8_t *image = file->bytes + (size_t)(frame % (int64_t)file->frames) * layout->frame_bytes;
    put_header(packet, flag, (uint8_t)(frame * layout->packets + number), ticks);
    memcpy(packet + PACKET_HEADER, image + number * layout->payload, (size_t)length);
    return length + PACKET_HEADER;
}
