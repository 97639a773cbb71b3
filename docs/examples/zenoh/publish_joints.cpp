// Publish joints so that robot-gst records them; docs/wire.md explains every step.
//
//     c++ -std=c++17 -DZENOHCXX_ZENOHC publish_joints.cpp -lzenohc    (zenoh-cpp 1.x over zenoh-c)
//     ./a.out tcp/127.0.0.1:7447 demo 500 100 [NUMBERS TO LEAVE OUT]
#include <array>
#include <chrono>
#include <cmath>
#include <random>
#include <set>
#include <string>
#include <thread>
#include <utility>
#include <vector>
#include <zenoh.hxx>

#include "joint_bytes.h"

namespace {

zenoh::Session open_session(const std::string& endpoint) {
    auto config = zenoh::Config::create_default();
    config.insert_json5("mode", "\"client\"");
    config.insert_json5("connect/endpoints", "[\"" + endpoint + "\"]");
    config.insert_json5("scouting/multicast/enabled", "false");
    return zenoh::Session::open(std::move(config));
}

zenoh::Publisher declare(zenoh::Session& session, const std::string& cell) {
    zenoh::Session::PublisherOptions options;
    options.encoding = zenoh::Encoding("application/cdr;sensor_msgs/msg/JointState");
    options.congestion_control = Z_CONGESTION_CONTROL_DROP;  // a control loop never waits
    options.priority = Z_PRIORITY_REAL_TIME;
    return session.declare_publisher(zenoh::KeyExpr(cell + "/joint_states"), std::move(options));
}

void publish(zenoh::Publisher& publisher, int64_t number, const std::array<uint8_t, 16>& gid) {
    using std::chrono::nanoseconds, std::chrono::duration_cast, std::chrono::system_clock;
    const auto since_1970 = system_clock::now().time_since_epoch();
    const int64_t stamp_ns = duration_cast<nanoseconds>(since_1970).count();
    const double angle_rad = std::sin(static_cast<double>(number) / 50);
    const std::array<double, 3> position_rad{angle_rad, -angle_rad, 0};
    std::vector<uint8_t> note(33), data(256);
    attachment(note.data(), number, stamp_ns, gid.data());
    data.resize(joint_state(data.data(), stamp_ns, position_rad.data()));
    zenoh::Publisher::PutOptions options;
    options.attachment = zenoh::Bytes(std::move(note));
    publisher.put(zenoh::Bytes(std::move(data)), std::move(options));
}

}  // namespace

int main(int argc, char** argv) {
    const std::vector<std::string> words(argv + 1, argv + argc);
    if (words.size() < 4) return 2;
    std::set<int64_t> left_out;
    for (size_t i = 4; i < words.size(); i++) left_out.insert(std::stoll(words[i]));
    std::array<uint8_t, 16> gid;
    std::random_device random;
    for (auto& byte : gid) byte = static_cast<uint8_t>(random());

    auto session = open_session(words[0]);
    auto token = session.liveliness_declare_token(zenoh::KeyExpr(words[1] + "/alive"));
    auto publisher = declare(session, words[1]);
    const std::chrono::duration<double> period(1 / std::stod(words[3]));
    for (int64_t number = 0; number < std::stoll(words[2]); number++) {
        std::this_thread::sleep_for(period);
        if (left_out.count(number) == 0) publish(publisher, number, gid);
    }
}
