// One stream: a thread that delivers the folder's images in a loop, each at its due time.
#include "virtual_device.hpp"

#include <algorithm>
#include <cstring>
#include <unistd.h>

static constexpr int WIDTH = 640, HEIGHT = 480;
static constexpr float HORIZONTAL_FOV = 1.0210f, VERTICAL_FOV = 0.7959f; // radians, FreenectDriver's 58.5 and 45.6 degrees
static constexpr int64_t LONGEST_NAP_US = 5000;                          // so that a stop is noticed soon

static const char* file_of(OniSensorType type) {
    return type == ONI_SENSOR_DEPTH ? "depth.bin" : "color.bin";
}

OniVideoMode VirtualStream::mode_of(OniSensorType type, const Folder& folder, double fps) {
    const bool fine = folder.text("depth_unit", "1mm") == "100um";
    OniVideoMode mode;
    mode.pixelFormat = type == ONI_SENSOR_COLOR ? ONI_PIXEL_FORMAT_RGB888
                       : fine                   ? ONI_PIXEL_FORMAT_DEPTH_100_UM
                                                : ONI_PIXEL_FORMAT_DEPTH_1_MM;
    mode.resolutionX = WIDTH;
    mode.resolutionY = HEIGHT;
    mode.fps = static_cast<int>(fps);
    return mode;
}

VirtualStream::VirtualStream(OniSensorType type, const Folder& folder, const DeviceClock& clock,
                             const std::atomic<bool>& registered)
    : type_(type), folder_(folder), clock_(clock), registered_(registered), mode_(mode_of(type, folder, clock.fps())),
      bytes_per_pixel_(type == ONI_SENSOR_DEPTH ? 2 : 3), mirrored_(folder.has("mirror")),
      plain_images_(folder.bytes(file_of(type))) {
    if (type == ONI_SENSOR_DEPTH)
        registered_images_ = folder.bytes("registered.bin");
}

OniStatus VirtualStream::start() {
    if (!running_.exchange(true))
        thread_ = std::thread([this] { run(); });
    return ONI_STATUS_OK;
}

void VirtualStream::stop() {
    running_ = false;
    if (thread_.joinable())
        thread_.join();
}

void VirtualStream::run() {
    // The next frame that both streams have in common, whichever of them started first.
    int64_t frame = static_cast<int64_t>(static_cast<double>(clock_.now_us()) * clock_.fps() / 1e6) + 1;
    for (; running_; frame++) {
        for (int64_t wait_us; running_ && (wait_us = clock_.due_us(frame) - clock_.now_us()) > 0;)
            usleep(static_cast<useconds_t>(std::min(wait_us, LONGEST_NAP_US)));
        if (running_ && !folder_.has("stall") && folder_.has("present"))
            deliver(frame);
    }
}

const std::vector<uint8_t>& VirtualStream::images() const {
    return type_ == ONI_SENSOR_DEPTH && registered_ ? registered_images_ : plain_images_;
}

void VirtualStream::deliver(int64_t number) {
    OniFrame* frame = getServices().acquireFrame();
    if (frame == nullptr)
        return;
    const size_t size = static_cast<size_t>(WIDTH) * HEIGHT * bytes_per_pixel_;
    frame->frameIndex = static_cast<int>(number);
    frame->timestamp = clock_.timestamp(clock_.due_us(number));
    frame->videoMode = mode_;
    frame->sensorType = type_;
    frame->width = WIDTH;
    frame->height = HEIGHT;
    frame->stride = WIDTH * bytes_per_pixel_;
    frame->dataSize = static_cast<int>(size);
    frame->croppingEnabled = FALSE;
    frame->cropOriginX = frame->cropOriginY = 0;
    const uint8_t* image = images().data() + static_cast<size_t>(number) % (images().size() / size) * size;
    uint8_t* pixels = static_cast<uint8_t*>(frame->data);
    std::memcpy(pixels, image, size);
    if (mirrored_)
        for (size_t pixel = 0; pixel < size / bytes_per_pixel_; pixel++) {
            const size_t opposite = pixel - pixel % WIDTH + (WIDTH - 1 - pixel % WIDTH);
            std::memcpy(pixels + opposite * bytes_per_pixel_, image + pixel * bytes_per_pixel_, bytes_per_pixel_);
        }
    raiseNewFrame(frame);
    getServices().releaseFrame(frame);
}

template <typename Value> static OniStatus give(const Value& value, void* data, int* size) {
    if (*size != static_cast<int>(sizeof value))
        return ONI_STATUS_BAD_PARAMETER;
    std::memcpy(data, &value, sizeof value);
    return ONI_STATUS_OK;
}

OniBool VirtualStream::isPropertySupported(int property) {
    switch (property) {
    case ONI_STREAM_PROPERTY_VIDEO_MODE:
    case ONI_STREAM_PROPERTY_CROPPING: // a Recorder asks for it
        return TRUE;
    case ONI_STREAM_PROPERTY_MIRRORING:
        return folder_.has("mirror");
    case ONI_STREAM_PROPERTY_HORIZONTAL_FOV:
    case ONI_STREAM_PROPERTY_VERTICAL_FOV:
        return !folder_.has("no_fov");
    case ONI_STREAM_PROPERTY_MIN_VALUE:
    case ONI_STREAM_PROPERTY_MAX_VALUE:
        return type_ == ONI_SENSOR_DEPTH;
    default:
        return FALSE;
    }
}

OniStatus VirtualStream::getProperty(int property, void* data, int* size) {
    if (!isPropertySupported(property))
        return ONI_STATUS_NOT_SUPPORTED;
    switch (property) {
    case ONI_STREAM_PROPERTY_VIDEO_MODE:
        return give(mode_, data, size);
    case ONI_STREAM_PROPERTY_CROPPING:
        return give(OniCropping{}, data, size);
    case ONI_STREAM_PROPERTY_MIRRORING:
        return give<OniBool>(mirrored_ ? TRUE : FALSE, data, size);
    case ONI_STREAM_PROPERTY_HORIZONTAL_FOV:
        return give(HORIZONTAL_FOV, data, size);
    case ONI_STREAM_PROPERTY_VERTICAL_FOV:
        return give(VERTICAL_FOV, data, size);
    default:
        return give<int>(property == ONI_STREAM_PROPERTY_MIN_VALUE ? 0 : 65535, data, size);
    }
}

OniStatus VirtualStream::setProperty(int property, const void* data, int size) {
    if (property != ONI_STREAM_PROPERTY_MIRRORING || size != static_cast<int>(sizeof(OniBool)))
        return ONI_STATUS_NOT_SUPPORTED;
    if (folder_.text("mirror", "") == "always")
        return ONI_STATUS_NOT_SUPPORTED;
    mirrored_ = *static_cast<const OniBool*>(data) != FALSE;
    return ONI_STATUS_OK;
}
