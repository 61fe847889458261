// The folder of one device, and the clock that is described in it.
#include "virtual_device.hpp"

#include <chrono>
#include <fstream>
#include <iterator>
#include <sstream>
#include <unistd.h>

static constexpr uint64_t TICKS_PER_US = 60;

bool Folder::has(const char* name) const {
    return access((path_ + "/" + name).c_str(), F_OK) == 0;
}

std::string Folder::text(const char* name, const char* otherwise) const {
    std::ifstream file(path_ + "/" + name);
    std::ostringstream text;
    text << file.rdbuf();
    return file.is_open() ? text.str() : otherwise;
}

std::vector<uint8_t> Folder::bytes(const char* name) const {
    std::ifstream file(path_ + "/" + name, std::ios::binary);
    return {std::istreambuf_iterator<char>(file), std::istreambuf_iterator<char>()};
}

void Folder::log(const std::string& line) const {
    std::ofstream(path_ + "/log", std::ios::app) << line + "\n";
}

static int64_t monotonic_us() {
    using namespace std::chrono;
    return duration_cast<microseconds>(steady_clock::now().time_since_epoch()).count();
}

DeviceClock::DeviceClock(const Folder& folder, double fps)
    : fps_(fps), ticks_(folder.text("clock", "us") == "ticks"),
      first_tick_(std::stoull(folder.text("first_tick", "0"))), power_on_us_(monotonic_us()) {}

int64_t DeviceClock::due_us(int64_t frame) const {
    return static_cast<int64_t>(static_cast<double>(frame) * 1e6 / fps_);
}

int64_t DeviceClock::now_us() const {
    return monotonic_us() - power_on_us_;
}

// Microseconds as OpenNI2 documents them, or the Kinect's own 32-bit counter as FreenectDriver 0.5.3 hands it on.
uint64_t DeviceClock::timestamp(int64_t since_us) const {
    const uint64_t us = static_cast<uint64_t>(since_us);
    return ticks_ ? static_cast<uint32_t>(first_tick_ + us * TICKS_PER_US) : first_tick_ / TICKS_PER_US + us;
}
