// A depth camera made of files, for the unmodified libOpenNI2; the folder's contents: virtual_devices.py.
#pragma once

#include <cstdlib>
#define XN_NEW(type, ...) new type(__VA_ARGS__)
#define XN_DELETE(object) delete object
#include "Driver/OniDriverAPI.h"

#include <atomic>
#include <cstdint>
#include <memory>
#include <mutex>
#include <string>
#include <thread>
#include <vector>

// One device's folder: what the test wrote into it, and the log that the test reads.
class Folder {
public:
    explicit Folder(std::string path) : path_(std::move(path)) {}
    const std::string& path() const { return path_; }
    bool has(const char* name) const;
    std::string text(const char* name, const char* otherwise) const;
    std::vector<uint8_t> bytes(const char* name) const;
    void log(const std::string& line) const;

private:
    std::string path_;
};

// The clock of a device: frame i of both streams is due at power-on + i / fps.
class DeviceClock {
public:
    DeviceClock(const Folder& folder, double fps);
    int64_t due_us(int64_t frame) const;       // since power-on
    uint64_t timestamp(int64_t since_us) const; // in the unit of the device
    int64_t now_us() const;                    // since power-on
    double fps() const { return fps_; }

private:
    double fps_;
    bool ticks_;
    uint64_t first_tick_;
    int64_t power_on_us_;
};

class VirtualStream : public oni::driver::StreamBase {
public:
    VirtualStream(OniSensorType type, const Folder& folder, const DeviceClock& clock, const std::atomic<bool>& registered);
    ~VirtualStream() override { stop(); }

    static OniVideoMode mode_of(OniSensorType type, const Folder& folder, double fps);

    OniStatus start() override;
    void stop() override;
    OniBool isPropertySupported(int property) override;
    OniStatus getProperty(int property, void* data, int* size) override;
    OniStatus setProperty(int property, const void* data, int size) override;

private:
    void run();
    void deliver(int64_t frame);
    const std::vector<uint8_t>& images() const;

    const OniSensorType type_;
    const Folder folder_;
    const DeviceClock& clock_;
    const std::atomic<bool>& registered_;
    const OniVideoMode mode_;
    const int bytes_per_pixel_;
    std::atomic<bool> mirrored_;
    std::vector<uint8_t> plain_images_, registered_images_;
    std::atomic<bool> running_{false};
    std::thread thread_;
};

class VirtualDevice : public oni::driver::DeviceBase {
public:
    VirtualDevice(const Folder& folder, double fps);
    ~VirtualDevice() override { folder_.log("close"); }

    OniStatus getSensorInfoList(OniSensorInfo** sensors, int* count) override;
    oni::driver::StreamBase* createStream(OniSensorType type) override;
    void destroyStream(oni::driver::StreamBase* stream) override { delete stream; }
    OniBool isPropertySupported(int property) override;
    OniStatus getProperty(int property, void* data, int* size) override;
    OniStatus setProperty(int property, const void* data, int size) override;
    OniBool isImageRegistrationModeSupported(OniImageRegistrationMode mode) override;

private:
    const Folder folder_;
    const DeviceClock clock_;
    std::atomic<bool> registered_{false};
    std::vector<OniVideoMode> modes_;
    std::vector<OniSensorInfo> sensors_;
};
