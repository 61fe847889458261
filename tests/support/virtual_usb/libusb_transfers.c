/* libusb API: isochronous transfers and the event loop.
 *
 * A host controller reserves microframes for a transfer when it is submitted: right after those of
 * the transfer before it, or from now on when the endpoint is idle. Unlike a real bus this one waits
 * for a host that is late, so that a test on a busy machine loses nothing but what it asks to lose.
 */
#include "virtual_usb.h"

#include <stdlib.h>

#define DEPTH_ENDPOINT 0x82
#define POLL_NS 2000000LL /* how soon unplugging and cancelling are noticed */
#define NO_LIMIT_NS 60000000000LL

struct queued {
    struct queued *next;
    uint64_t plug;
    int64_t first_slot;
    bool cancelled;
    _Alignas(16) struct libusb_transfer transfer; /* last: libusb.h lets it grow by its packets */
};

static struct queued *queue; /* submitted and not yet called back; in order of submission */

static struct queued *queued_of(struct libusb_transfer *transfer)
{
    return (struct queued *)((char *)transfer - offsetof(struct queued, transfer));
}

struct libusb_transfer *libusb_alloc_transfer(int packets)
{
    size_t size = sizeof(struct queued) + (size_t)packets * sizeof(struct libusb_iso_packet_descriptor);
    struct queued *queued = calloc(1, size);
    return &queued->transfer;
}

void libusb_free_transfer(struct libusb_transfer *transfer)
{
    if (transfer)
        free(queued_of(transfer));
}

static struct kinect *kinect_of(const struct libusb_transfer *transfer)
{
    return transfer->dev_handle->device->kinect;
}

static enum stream_id stream_of(const struct libusb_transfer *transfer)
{
    return transfer->endpoint == DEPTH_ENDPOINT ? DEPTH : VIDEO;
}

static void append(struct queued *queued)
{
    struct queued **end = &queue;
    while (*end)
        end = &(*end)->next;
    queued->next = NULL;
    *end = queued;
}

int libusb_submit_transfer(struct libusb_transfer *transfer)
{
    struct queued *queued = queued_of(transfer);
    struct kinect *kinect = kinect_of(transfer);
    bool isochronous = transfer->type == LIBUSB_TRANSFER_TYPE_ISOCHRONOUS;
    if (!isochronous || transfer->dev_handle->device->function != CAMERA)
        return LIBUSB_ERROR_NOT_SUPPORTED;
    bus_lock();
    bool alive = handle_alive(transfer->dev_handle);
    if (alive) {
        struct stream *stream = &kinect->streams[stream_of(transfer)];
        queued->first_slot = stream->pending++ ? stream->next_free_slot : kinect_slot(kinect) + 1;
        stream->next_free_slot = queued->first_slot + transfer->num_iso_packets;
        queued->plug = kinect->plug;
        queued->cancelled = false;
        append(queued);
    }
    bus_unlock();
    return alive ? 0 : LIBUSB_ERROR_NO_DEVICE;
}

int libusb_cancel_transfer(struct libusb_transfer *transfer)
{
    int result = LIBUSB_ERROR_NOT_FOUND;
    bus_lock();
    for (struct queued *queued = queue; queued; queued = queued->next) {
        if (&queued->transfer == transfer) {
            queued->cancelled = true;
            result = 0;
        }
    }
    bus_unlock();
    return result;
}

static void fill(struct queued *queued)
{
    struct libusb_transfer *transfer = &queued->transfer;
    uint8_t *packet = transfer->buffer;
    for (int i = 0; i < transfer->num_iso_packets; i++) {
        struct libusb_iso_packet_descriptor *descriptor = &transfer->iso_packet_desc[i];
        int64_t slot = queued->first_slot + i;
        descriptor->status = LIBUSB_TRANSFER_COMPLETED;
        descriptor->actual_length = (unsigned)stream_packet(
            kinect_of(transfer), stream_of(transfer), slot, packet, (int)descriptor->length);
        packet += descriptor->length;
    }
}

/* When this transfer's last microframe is over; 0 when it ends now for another reason. */
static int64_t due_ns(const struct queued *queued)
{
    struct kinect *kinect = kinect_of(&queued->transfer);
    if (queued->cancelled || !kinect_refresh(kinect) || queued->plug != kinect->plug)
        return 0;
    return kinect->powered_ns + (queued->first_slot + queued->transfer.num_iso_packets) * SLOT_NS;
}

static void finish(struct queued *queued)
{
    struct kinect *kinect = kinect_of(&queued->transfer);
    if (queued->cancelled) {
        queued->transfer.status = LIBUSB_TRANSFER_CANCELLED;
    } else if (!kinect->present || queued->plug != kinect->plug) {
        queued->transfer.status = LIBUSB_TRANSFER_NO_DEVICE;
    } else {
        queued->transfer.status = LIBUSB_TRANSFER_COMPLETED;
        fill(queued);
    }
}

/* Take the transfer of this bus that is due first out of the queue, or NULL and when to look again. */
static struct queued *take_due(struct bus *bus, int64_t *look_again_ns)
{
    struct queued **earliest = NULL;
    int64_t earliest_ns = now_ns() + POLL_NS;
    for (struct queued **link = &queue; *link; link = &(*link)->next) {
        if (kinect_of(&(*link)->transfer)->bus != bus)
            continue;
        int64_t due = due_ns(*link);
        if (due < earliest_ns) {
            earliest_ns = due;
            earliest = link;
        }
    }
    *look_again_ns = earliest_ns;
    if (!earliest || earliest_ns > now_ns())
        return NULL;
    struct queued *due = *earliest;
    *earliest = due->next;
    if (due->plug == kinect_of(&due->transfer)->plug)
        kinect_of(&due->transfer)->streams[stream_of(&due->transfer)].pending--;
    return due;
}

static bool run_callbacks(struct bus *bus, int64_t *look_again_ns)
{
    bool any = false;
    for (;;) {
        bus_lock();
        struct queued *due = take_due(bus, look_again_ns);
        if (due)
            finish(due);
        bus_unlock();
        if (!due)
            return any;
        due->transfer.callback(&due->transfer); /* it may submit or free the transfer */
        any = true;
    }
}

int libusb_handle_events_timeout_completed(libusb_context *context, struct timeval *timeout, int *completed)
{
    int64_t limit_ns = timeout ? timeout->tv_sec * 1000000000LL + timeout->tv_usec * 1000LL : NO_LIMIT_NS;
    int64_t end_ns = now_ns() + limit_ns;
    int64_t look_again_ns;
    struct bus *bus = bus_of_context(context);
    while (!run_callbacks(bus, &look_again_ns) && !(completed && *completed)) {
        int64_t now = now_ns();
        if (now >= end_ns)
            break;
        int64_t wake_ns = look_again_ns < end_ns ? look_again_ns : end_ns;
        if (wake_ns > now)
            sleep_ns(wake_ns - now);
    }
    return 0;
}

int libusb_handle_events_timeout(libusb_context *context, struct timeval *timeout)
{
    return libusb_handle_events_timeout_completed(context, timeout, NULL);
}

int libusb_handle_events_completed(libusb_context *context, int *completed)
{
    return libusb_handle_events_timeout_completed(context, NULL, completed);
}

int libusb_handle_events(libusb_context *context)
{
    return libusb_handle_events_timeout_completed(context, NULL, NULL);
}
