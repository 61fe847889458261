// The driver that libOpenNI2 loads: lists the folders of RIG_OPENNI_DIR, and tells when one comes or goes.
#include "virtual_device.hpp"

#include <cstring>
#include <dirent.h>
#include <map>
#include <set>
#include <unistd.h>

static constexpr useconds_t SCAN_INTERVAL_US = 10000;
static constexpr const char* SCHEME = "virtual://";

static std::string environment(const char* name, const char* otherwise) {
    const char* value = getenv(name);
    return value != nullptr ? value : otherwise;
}

class VirtualDriver : public oni::driver::DriverBase {
public:
    explicit VirtualDriver(OniDriverServices* services) : DriverBase(services) {}

    OniStatus initialize(oni::driver::DeviceConnectedCallback connected,
                         oni::driver::DeviceDisconnectedCallback disconnected,
                         oni::driver::DeviceStateChangedCallback changed, void* cookie) override {
        DriverBase::initialize(connected, disconnected, changed, cookie);
        root_ = environment("RIG_OPENNI_DIR", "");
        fps_ = std::stod(environment("RIG_OPENNI_FPS", "30"));
        scan();
        running_ = true;
        thread_ = std::thread([this] {
            for (; running_; usleep(SCAN_INTERVAL_US))
                scan();
        });
        return ONI_STATUS_OK;
    }

    void shutdown() override {
        running_ = false;
        if (thread_.joinable())
            thread_.join();
    }

    oni::driver::DeviceBase* deviceOpen(const char* uri, const char*) override {
        const std::lock_guard<std::mutex> lock(mutex_);
        for (const auto& [name, info] : devices_) {
            const Folder folder(root_ + "/" + name);
            if (std::strcmp(info.uri, uri) == 0 && !folder.has("deny"))
                return new VirtualDevice(folder, fps_);
        }
        return nullptr;
    }

    void deviceClose(oni::driver::DeviceBase* device) override { delete device; }

private:
    std::set<std::string> plugged() const {
        std::set<std::string> names;
        DIR* root = opendir(root_.c_str());
        while (const dirent* entry = root != nullptr ? readdir(root) : nullptr)
            if (entry->d_name[0] != '.' && Folder(root_ + "/" + entry->d_name).has("present"))
                names.insert(entry->d_name);
        if (root != nullptr)
            closedir(root);
        return names;
    }

    // Listeners are called without the lock: they may open a device.
    void scan() {
        const std::set<std::string> now = plugged();
        std::vector<OniDeviceInfo> arrived, left;
        {
            const std::lock_guard<std::mutex> lock(mutex_);
            for (const std::string& name : now)
                if (devices_.count(name) == 0)
                    arrived.push_back(devices_[name] = info_of(name));
            for (auto device = devices_.begin(); device != devices_.end();)
                if (now.count(device->first) == 0) {
                    left.push_back(device->second);
                    device = devices_.erase(device);
                } else {
                    ++device;
                }
        }
        for (const OniDeviceInfo& info : arrived)
            deviceConnected(&info);
        for (const OniDeviceInfo& info : left)
            deviceDisconnected(&info);
    }

    OniDeviceInfo info_of(const std::string& name) const {
        OniDeviceInfo info{};
        std::strncpy(info.uri, (SCHEME + name).c_str(), sizeof info.uri - 1);
        std::strncpy(info.vendor, "Kinect rig", sizeof info.vendor - 1);
        std::strncpy(info.name, "Virtual depth camera", sizeof info.name - 1);
        return info;
    }

    std::string root_;
    double fps_ = 30;
    std::mutex mutex_;
    std::map<std::string, OniDeviceInfo> devices_;
    std::atomic<bool> running_{false};
    std::thread thread_;
};

ONI_EXPORT_DRIVER(VirtualDriver)
