/* One virtual Kinect: its folder, plugging and unplugging, faults, log. */
#define _GNU_SOURCE
#include "virtual_usb.h"

#include <fcntl.h>
#include <pthread.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <strings.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <time.h>
#include <unistd.h>

#define REFRESH_NS 4000000LL /* how often the folder is looked at */
#define DEFAULT_FPS 30.0
#define NO_BUS "/nonexistent"

static const char *const FRAME_FILES[IMAGE_KINDS] = {
    [BAYER] = "bayer.bin",   [BAYER_HIGH] = "bayer_high.bin", [IR] = "ir.bin",
    [IR_HIGH] = "ir_high.bin", [DEPTH_11BIT] = "depth11.bin",
};

static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;
static struct bus *buses;

void bus_lock(void) { pthread_mutex_lock(&lock); }
void bus_unlock(void) { pthread_mutex_unlock(&lock); }

int64_t now_ns(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return now.tv_sec * 1000000000LL + now.tv_nsec;
}

void sleep_ns(int64_t duration_ns)
{
    struct timespec duration = {duration_ns / 1000000000LL, duration_ns % 1000000000LL};
    nanosleep(&duration, NULL);
}

static struct bus *bus_create(const char *folder)
{
    struct bus *bus = calloc(1, sizeof *bus);
    snprintf(bus->folder, sizeof bus->folder, "%s", folder);
    for (int i = 0; i < MAX_KINECTS; i++) {
        struct kinect *kinect = &bus->kinects[i];
        kinect->bus = bus;
        kinect->index = i;
        snprintf(kinect->folder, sizeof kinect->folder, "%.*s/%d", PATH_MAX - 4, folder, i);
        for (int f = 0; f < FUNCTIONS; f++)
            kinect->functions[f] = (struct libusb_device){kinect, (enum function)f};
    }
    bus->next = buses;
    buses = bus;
    return bus;
}

/* The bus in the folder VKINECT_DIR; contexts of one folder share it. */
struct bus *bus_of_environment(void)
{
    const char *folder = getenv("VKINECT_DIR");
    const char *fps = getenv("VKINECT_FPS");
    if (!folder)
        folder = NO_BUS;
    struct bus *bus = buses;
    while (bus && strcmp(bus->folder, folder))
        bus = bus->next;
    if (!bus)
        bus = bus_create(folder);
    bus->frame_ns = (int64_t)(1e9 / (fps ? atof(fps) : DEFAULT_FPS));
    return bus;
}

static const char *kinect_path(const struct kinect *kinect, const char *name)
{
    static char path[PATH_MAX + 32]; /* used under the lock only */
    snprintf(path, sizeof path, "%s/%s", kinect->folder, name);
    return path;
}

static bool has(const struct kinect *kinect, const char *name)
{
    return access(kinect_path(kinect, name), F_OK) == 0;
}

/* The first line of a file in the Kinect's folder; empty when there is none. */
void kinect_read_line(struct kinect *kinect, const char *name, char *line, size_t size)
{
    line[0] = 0;
    FILE *file = fopen(kinect_path(kinect, name), "r");
    if (!file)
        return;
    if (fgets(line, (int)size, file))
        line[strcspn(line, "\r\n")] = 0;
    fclose(file);
}

void kinect_log(struct kinect *kinect, const char *format, ...)
{
    FILE *file = fopen(kinect_path(kinect, "log"), "a");
    if (!file)
        return;
    va_list arguments;
    va_start(arguments, format);
    vfprintf(file, format, arguments);
    va_end(arguments);
    fputc('\n', file);
    fclose(file);
}

static void frame_file_map(struct frame_file *file, const char *path, size_t frame_bytes)
{
    if (file->bytes)
        munmap((void *)file->bytes, file->size);
    *file = (struct frame_file){0};
    int descriptor = open(path, O_RDONLY | O_CLOEXEC);
    struct stat status;
    if (descriptor < 0)
        return;
    if (fstat(descriptor, &status) == 0 && (size_t)status.st_size >= frame_bytes) {
        void *bytes = mmap(NULL, (size_t)status.st_size, PROT_READ, MAP_SHARED, descriptor, 0);
        if (bytes != MAP_FAILED)
            *file = (struct frame_file){bytes, (size_t)status.st_size, (size_t)status.st_size / frame_bytes};
    }
    close(descriptor);
}

static enum model model_of(const char *name)
{
    if (!strcmp(name, "1473"))
        return MODEL_1473;
    return strcasecmp(name, "k4w") ? MODEL_1414 : MODEL_K4W;
}

static void firmware_start(struct kinect *kinect)
{
    memset(kinect->registers, 0, sizeof kinect->registers);
    memset(kinect->cmos, 0, sizeof kinect->cmos);
    kinect->reply_length = 0;
    for (int id = 0; id < STREAMS; id++)
        stream_stop(kinect, id);
}

static void power_on(struct kinect *kinect, uint64_t identity)
{
    char line[64];
    kinect->present = true;
    kinect->plug++;
    kinect->plug_identity = identity;
    kinect->powered_ns = now_ns();
    kinect->camera_claimed_by = NULL;
    kinect->random = 1;
    kinect_read_line(kinect, "serial", kinect->serial, sizeof kinect->serial);
    kinect_read_line(kinect, "model", line, sizeof line);
    kinect->model = model_of(line);
    kinect_read_line(kinect, "first_tick", line, sizeof line);
    kinect->first_tick = (uint32_t)strtoul(line, NULL, 0);
    kinect->audio_firmware = !has(kinect, "no_firmware");
    kinect->audio_answer_count = 0;
    for (int kind = 0; kind < IMAGE_KINDS; kind++)
        frame_file_map(&kinect->frames[kind], kinect_path(kinect, FRAME_FILES[kind]), image_bytes(kind));
    for (int id = 0; id < STREAMS; id++)
        kinect->streams[id].pending = 0;
    firmware_start(kinect);
}

static void read_faults(struct kinect *kinect)
{
    static const char *const lose_packet[STREAMS] = {"lose_video_packet", "lose_depth_packet"};
    struct faults *faults = &kinect->faults;
    char line[64];
    faults->deny = has(kinect, "deny");
    faults->busy = has(kinect, "busy");
    faults->mute = has(kinect, "mute");
    faults->mute_motor = has(kinect, "mute_motor");
    faults->deaf_sensor = has(kinect, "deaf_sensor");
    faults->stall = has(kinect, "stall");
    kinect_read_line(kinect, "lose", line, sizeof line);
    faults->lose_percent = atof(line);
    for (int id = 0; id < STREAMS; id++) {
        kinect_read_line(kinect, lose_packet[id], line, sizeof line);
        if (sscanf(line, "%d %d", &faults->lose_packet[id], &faults->lose_every[id]) != 2)
            faults->lose_packet[id] = -1;
    }
}

bool kinect_refresh(struct kinect *kinect)
{
    int64_t now = now_ns();
    if (now < kinect->next_refresh_ns)
        return kinect->present;
    kinect->next_refresh_ns = now + REFRESH_NS;
    struct stat status;
    if (stat(kinect_path(kinect, "present"), &status)) {
        kinect->present = false;
        return false;
    }
    uint64_t identity = (uint64_t)status.st_ino * 1000003u + (uint64_t)status.st_mtim.tv_nsec;
    if (!kinect->present || identity != kinect->plug_identity)
        power_on(kinect, identity);
    read_faults(kinect);
    return true;
}

/* Microframes since power-on. */
int64_t kinect_slot(const struct kinect *kinect) { return (now_ns() - kinect->powered_ns) / SLOT_NS; }

/* What a USB reset of the camera does: the firmware starts anew, and unanswered transfers fail. */
void kinect_reset(struct kinect *kinect)
{
    kinect->resets++;
    unlink(kinect_path(kinect, "mute"));
    kinect->faults.mute = false;
    firmware_start(kinect);
}

bool handle_alive(libusb_device_handle *handle)
{
    return kinect_refresh(handle->device->kinect) && handle->plug == handle->device->kinect->plug;
}
