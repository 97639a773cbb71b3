//! Publish joints so that robot-gst records them; docs/wire.md explains every step.
//!
//! src/main.rs of a package with `zenoh = "1"`, joint_bytes.rs beside it:
//!     cargo run --release -- tcp/127.0.0.1:7447 demo 500 100 [NUMBERS TO LEAVE OUT]

mod joint_bytes;

use std::collections::HashSet;
use std::io::Read;
use std::time::{Duration, SystemTime, UNIX_EPOCH};
use zenoh::qos::{CongestionControl, Priority};
use zenoh::Wait;

type Failure = Box<dyn std::error::Error + Send + Sync>;

fn open_session(endpoint: &str) -> Result<zenoh::Session, Failure> {
    let mut config = zenoh::Config::default();
    config.insert_json5("mode", "\"client\"")?;
    config.insert_json5("connect/endpoints", &format!("[\"{endpoint}\"]"))?;
    config.insert_json5("scouting/multicast/enabled", "false")?;
    zenoh::open(config).wait()
}

fn main() -> Result<(), Failure> {
    let words: Vec<String> = std::env::args().skip(1).collect();
    let [endpoint, cell, count, rate_hz, left_out @ ..] = words.as_slice() else {
        return Err("ENDPOINT CELL COUNT RATE_HZ [NUMBERS TO LEAVE OUT]".into());
    };
    let left_out: HashSet<i64> = left_out.iter().map(|n| n.parse()).collect::<Result<_, _>>()?;
    let mut gid = [0u8; 16];
    std::fs::File::open("/dev/urandom")?.read_exact(&mut gid)?;

    let session = open_session(endpoint)?;
    let _token = session.liveliness().declare_token(format!("{cell}/alive")).wait()?;
    let publisher = session
        .declare_publisher(format!("{cell}/joint_states"))
        .encoding("application/cdr;sensor_msgs/msg/JointState")
        .congestion_control(CongestionControl::Drop) // a control loop never waits
        .priority(Priority::RealTime)
        .wait()?;
    let period = Duration::from_secs_f64(1.0 / rate_hz.parse::<f64>()?);
    for number in 0..count.parse::<i64>()? {
        std::thread::sleep(period);
        if left_out.contains(&number) {
            continue;
        }
        let stamp_ns = SystemTime::now().duration_since(UNIX_EPOCH)?.as_nanos() as i64;
        let angle_rad = (number as f64 / 50.0).sin();
        publisher
            .put(joint_bytes::joint_state(stamp_ns, [angle_rad, -angle_rad, 0.0]))
            .attachment(joint_bytes::attachment(number, stamp_ns, &gid))
            .wait()?;
    }
    Ok(())
}
