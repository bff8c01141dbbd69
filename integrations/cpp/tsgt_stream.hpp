// Poses of tsgt in C++17: one header, POSIX, no other library.
//
//     tsgt::Stream stream("/run/tsgt/poses.sock");                       // on the robot's computer
//     tsgt::Stream stream("relay://192.168.1.10", "relay.key");          // on another one, from `tsgt relay` without TLS
//     while (auto record = stream.next(std::chrono::hours(1)))           // everything, in order; or, in a control loop,
//       if (const auto* pose = std::get_if<tsgt::Pose>(&*record)) ...
//     if (const tsgt::Pose* pose = stream.latest(0.2)) ...               // null while the newest one is older than 0.2 s
//
// It has no TLS: the relay's key keeps strangers out and lines unchanged, but everybody on the network can read them. To encrypt:
// `ssh -N -L 27690:127.0.0.1:27690 robot`, and relay://127.0.0.1 here.
//
// It connects again by itself, goes on after the last line that it has got from a relay, and tells what is missing (Gap).
// docs/reference/stream.md has the fields with units and frames, docs/reference/relay.md the relay's protocol.
// Not for several threads at once. Nothing here waits longer than it is told to, but for the look-up of a name: give numeric
// addresses where that matters.

#ifndef TSGT_STREAM_HPP
#define TSGT_STREAM_HPP

#include <arpa/inet.h>
#include <fcntl.h>
#include <netdb.h>
#include <poll.h>
#include <sys/random.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/un.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <cerrno>
#include <charconv>
#include <chrono>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <ctime>
#include <deque>
#include <fstream>
#include <locale>
#include <map>
#include <optional>
#include <sstream>
#include <stdexcept>
#include <string>
#include <string_view>
#include <utility>
#include <variant>
#include <vector>

namespace tsgt {

// Another attempt does not help: another protocol, a wrong key, a wrong argument.
class Error : public std::runtime_error {
 public:
  using std::runtime_error::runtime_error;
};

// The clock that ages are measured by: never set, and counts while the computer is suspended.
inline std::int64_t monotonic_ns() {
#ifdef CLOCK_BOOTTIME
  constexpr clockid_t clock = CLOCK_BOOTTIME;
#else
  constexpr clockid_t clock = CLOCK_MONOTONIC;
#endif
  timespec now{};
  clock_gettime(clock, &now);
  return std::int64_t{now.tv_sec} * 1000000000 + now.tv_nsec;
}

namespace detail {

// The sum, or the largest number of its sign: times from outside may be absurd. Its negative always fits, too.
inline std::int64_t sum(std::int64_t a, std::int64_t b) {
  if (b > 0 && a > INT64_MAX - b) return INT64_MAX;
  if (b < 0 && a < -INT64_MAX - b) return -INT64_MAX;
  return a + b;
}

}  // namespace detail

// ---------------------------------------------------------------------------------------------------------------------
// JSON, as far as lines of the stream need it. Integers keep all 64 bits; larger ones, and numbers with a
// fraction, become the nearest double.

namespace json {

class Value;
using Array = std::vector<Value>;
using Object = std::map<std::string, Value, std::less<>>;

class Value {
 public:
  std::variant<std::nullptr_t, bool, std::int64_t, double, std::string, Array, Object> data = nullptr;

  bool is_null() const { return std::holds_alternative<std::nullptr_t>(data); }

  // The value of a key; null where there is none.
  const Value& operator[](std::string_view key) const {
    static const Value null;
    const auto* object = std::get_if<Object>(&data);
    if (object == nullptr) return null;
    const auto found = object->find(key);
    return found == object->end() ? null : found->second;
  }

  std::int64_t integer() const { return get<std::int64_t>("an integer"); }
  bool boolean() const { return get<bool>("true or false"); }
  const std::string& text() const { return get<std::string>("a string"); }
  const Array& array() const { return get<Array>("a list"); }
  double number() const {
    if (const auto* whole = std::get_if<std::int64_t>(&data)) return static_cast<double>(*whole);
    return get<double>("a number");
  }

 private:
  template <typename T>
  const T& get(const char* expected) const {
    if (const auto* value = std::get_if<T>(&data)) return *value;
    throw std::invalid_argument(std::string("expected ") + expected);
  }
};

class Parser {
 public:
  explicit Parser(std::string_view text) : text_(text) {}

  // Throws std::invalid_argument if the text is not one JSON value.
  Value parse() {
    Value value = parse_value(0);
    skip_space();
    if (at_ != text_.size()) fail();
    return value;
  }

 private:
  static constexpr int kMaxDepth = 64;

  [[noreturn]] static void fail() { throw std::invalid_argument("not JSON"); }

  char peek() const { return at_ < text_.size() ? text_[at_] : '\0'; }

  void skip_space() {
    while (at_ < text_.size() && std::strchr(" \t\r\n", text_[at_]) != nullptr) ++at_;
  }

  bool take(std::string_view word) {
    if (text_.substr(at_, word.size()) != word) return false;
    at_ += word.size();
    return true;
  }

  void need(std::string_view word) {
    skip_space();
    if (!take(word)) fail();
  }

  Value parse_value(int depth) {
    if (depth > kMaxDepth) fail();
    skip_space();
    Value value;
    if (take("null")) return value;
    if (take("true")) {
      value.data = true;
    } else if (take("false")) {
      value.data = false;
    } else if (peek() == '"') {
      value.data = parse_string();
    } else if (take("[")) {
      Array items;
      skip_space();
      if (!take("]")) {
        do items.push_back(parse_value(depth + 1));
        while (skip_space(), take(","));
        need("]");
      }
      value.data = std::move(items);
    } else if (take("{")) {
      Object members;
      skip_space();
      if (!take("}")) {
        do {
          skip_space();
          std::string key = parse_string();
          need(":");
          members.insert_or_assign(std::move(key), parse_value(depth + 1));
        } while (skip_space(), take(","));
        need("}");
      }
      value.data = std::move(members);
    } else {
      parse_number(value);
    }
    return value;
  }

  void take_digits() {
    const std::size_t start = at_;
    while (peek() >= '0' && peek() <= '9') ++at_;
    if (at_ == start) fail();
  }

  void parse_number(Value& value) {
    const std::size_t start = at_;
    bool whole = true;
    take("-");
    if (!take("0")) take_digits();
    if (take(".")) {
      whole = false;
      take_digits();
    }
    if (take("e") || take("E")) {
      whole = false;
      if (!take("+")) take("-");
      take_digits();
    }
    const char* begin = text_.data() + start;
    const char* end = text_.data() + at_;
    if (whole) {
      std::int64_t integer = 0;
      if (std::from_chars(begin, end, integer).ec == std::errc()) {
        value.data = integer;
        return;
      }
    }
    double number = 0;
#if defined(__cpp_lib_to_chars) && __cpp_lib_to_chars >= 201611L
    if (std::from_chars(begin, end, number).ec == std::errc()) {
      value.data = number;
      return;
    }
#endif
    std::istringstream stream(std::string(begin, end));  // tells too small, which is nearly 0, from too large
    stream.imbue(std::locale::classic());
    if (!(stream >> number) && !(std::abs(number) < 1)) fail();
    value.data = number;
  }

  std::string parse_string() {
    if (!take("\"")) fail();
    std::string result;
    while (true) {
      if (at_ >= text_.size()) fail();
      const char c = text_[at_++];
      if (c == '"') return result;
      if (static_cast<unsigned char>(c) < 0x20) fail();
      if (c != '\\') {
        result += c;
        continue;
      }
      const char escaped = at_ < text_.size() ? text_[at_++] : '\0';
      switch (escaped) {
        case '"': case '\\': case '/': result += escaped; break;
        case 'b': result += '\b'; break;
        case 'f': result += '\f'; break;
        case 'n': result += '\n'; break;
        case 'r': result += '\r'; break;
        case 't': result += '\t'; break;
        case 'u': append_utf8(result, parse_code_point()); break;
        default: fail();
      }
    }
  }

  unsigned parse_hex4() {
    unsigned code = 0;
    if (text_.size() - at_ < 4) fail();
    const auto [rest, error] = std::from_chars(text_.data() + at_, text_.data() + at_ + 4, code, 16);
    if (error != std::errc() || rest != text_.data() + at_ + 4) fail();
    at_ += 4;
    return code;
  }

  unsigned parse_code_point() {
    const unsigned first = parse_hex4();
    if (first < 0xD800 || first > 0xDFFF) return first;
    if (first > 0xDBFF || !take("\\u")) fail();
    const unsigned second = parse_hex4();
    if (second < 0xDC00 || second > 0xDFFF) fail();
    return 0x10000 + ((first - 0xD800) << 10) + (second - 0xDC00);
  }

  static void append_utf8(std::string& result, unsigned code) {
    const auto add = [&result](unsigned byte) { result += static_cast<char>(byte); };
    if (code < 0x80) {
      add(code);
    } else if (code < 0x800) {
      add(0xC0 | code >> 6), add(0x80 | (code & 0x3F));
    } else if (code < 0x10000) {
      add(0xE0 | code >> 12), add(0x80 | (code >> 6 & 0x3F)), add(0x80 | (code & 0x3F));
    } else {
      add(0xF0 | code >> 18), add(0x80 | (code >> 12 & 0x3F)), add(0x80 | (code >> 6 & 0x3F)), add(0x80 | (code & 0x3F));
    }
  }

  std::string_view text_;
  std::size_t at_ = 0;
};

}  // namespace json

// ---------------------------------------------------------------------------------------------------------------------
// Records

struct Hello {
  std::string version;  // of the software
};

struct Pose {
  std::int64_t stamp_ns = 0;  // on the master's Unix clock
  std::string frame, child_frame, estimator, kind, reason, quality;
  std::optional<double> delay_s;  // of a smoothed pose at a delay
  bool valid = false;             // an invalid pose may lack numbers; `reason` says why
  std::optional<std::array<double, 3>> position_m, velocity_mps, angular_velocity_radps;
  std::optional<std::array<double, 4>> orientation_xyzw;
  std::optional<std::array<double, 36>> covariance, covariance_common;
  std::optional<double> residual_m;
  std::int64_t epoch_ns = 0;  // time of the pose on monotonic_ns() of this computer

  // Time since the pose's epoch in s, by this computer's clock alone; too small by the least delay of any line.
  double age_s() const { return static_cast<double>(detail::sum(monotonic_ns(), -epoch_ns)) / 1e9; }
};

struct Event {
  std::int64_t stamp_ns = 0;
  std::string event, message;
  std::optional<std::int64_t> station, count;
};

// A line of another type: `setup`, `status`, `measurement`, ...
struct Other {
  std::string type;
  json::Value line;
};

// Lines are missing here.
struct Gap {
  std::optional<std::int64_t> lines;  // how many, if known
  std::string reason;
};

using Record = std::variant<Hello, Pose, Event, Other, Gap>;

// ---------------------------------------------------------------------------------------------------------------------

namespace detail {

constexpr int kProtocol = 1;
constexpr const char* kRelay = "tsgt-relay 1";
constexpr std::int64_t kSecond = 1000000000;
constexpr std::int64_t kConnectTimeout = 5 * kSecond;
constexpr std::int64_t kSilenceTimeout = 5 * kSecond;  // a relay sends something each second
constexpr std::int64_t kFirstBackOff = kSecond / 10;
constexpr std::int64_t kMaxBackOff = 2 * kSecond;
constexpr std::int64_t kPrompt = kSecond / 10;  // what is read this soon after the socket was empty has arrived just now
constexpr std::int64_t kSteady = kSecond / 20;  // a backlog is read when the offset has not fallen by this much in this time
constexpr std::int64_t kUnknown = 2 * kSecond;  // how long poses wait for a line that tells the offset
constexpr std::int64_t kMaxPause = 250 * kSecond;  // two clocks may drift apart by 50 ms in this time
constexpr std::int64_t kNoOffset = INT64_MAX;
constexpr std::size_t kMaxHeld = 4000;  // records; more than a queue of the master has
constexpr std::size_t kMaxLine = (1 << 20) + 256;
constexpr std::size_t kMaxHandshake = 512;
constexpr std::size_t kDigits = 64;  // of a nonce, a key and a proof

// The connection cannot be used; another one may.
class Lost : public std::runtime_error {
 public:
  using std::runtime_error::runtime_error;
};

// SHA-256 (FIPS 180-4).
inline std::string sha256(std::string message) {
  static constexpr std::array<std::uint32_t, 64> k = {
      0x428a2f98, 0x71374491, 0xb5c0fbcf, 0xe9b5dba5, 0x3956c25b, 0x59f111f1, 0x923f82a4, 0xab1c5ed5, 0xd807aa98, 0x12835b01,
      0x243185be, 0x550c7dc3, 0x72be5d74, 0x80deb1fe, 0x9bdc06a7, 0xc19bf174, 0xe49b69c1, 0xefbe4786, 0x0fc19dc6, 0x240ca1cc,
      0x2de92c6f, 0x4a7484aa, 0x5cb0a9dc, 0x76f988da, 0x983e5152, 0xa831c66d, 0xb00327c8, 0xbf597fc7, 0xc6e00bf3, 0xd5a79147,
      0x06ca6351, 0x14292967, 0x27b70a85, 0x2e1b2138, 0x4d2c6dfc, 0x53380d13, 0x650a7354, 0x766a0abb, 0x81c2c92e, 0x92722c85,
      0xa2bfe8a1, 0xa81a664b, 0xc24b8b70, 0xc76c51a3, 0xd192e819, 0xd6990624, 0xf40e3585, 0x106aa070, 0x19a4c116, 0x1e376c08,
      0x2748774c, 0x34b0bcb5, 0x391c0cb3, 0x4ed8aa4a, 0x5b9cca4f, 0x682e6ff3, 0x748f82ee, 0x78a5636f, 0x84c87814, 0x8cc70208,
      0x90befffa, 0xa4506ceb, 0xbef9a3f7, 0xc67178f2};
  std::array<std::uint32_t, 8> h = {0x6a09e667, 0xbb67ae85, 0x3c6ef372, 0xa54ff53a, 0x510e527f, 0x9b05688c, 0x1f83d9ab, 0x5be0cd19};
  const std::uint64_t bits = std::uint64_t{message.size()} * 8;
  message += '\x80';
  while (message.size() % 64 != 56) message += '\0';
  for (int shift = 56; shift >= 0; shift -= 8) message += static_cast<char>(bits >> shift & 0xFF);
  const auto rotate = [](std::uint32_t x, int n) { return x >> n | x << (32 - n); };
  for (std::size_t block = 0; block < message.size(); block += 64) {
    std::array<std::uint32_t, 64> w{};
    for (std::size_t i = 0; i < 64; ++i)
      w[i / 4 % 16] = w[i / 4 % 16] << 8 | static_cast<unsigned char>(message[block + i]);
    for (std::size_t i = 16; i < 64; ++i) {
      const std::uint32_t a = rotate(w[i - 15], 7) ^ rotate(w[i - 15], 18) ^ w[i - 15] >> 3;
      const std::uint32_t b = rotate(w[i - 2], 17) ^ rotate(w[i - 2], 19) ^ w[i - 2] >> 10;
      w[i] = w[i - 16] + a + w[i - 7] + b;
    }
    auto s = h;
    for (std::size_t i = 0; i < 64; ++i) {
      const std::uint32_t e = rotate(s[4], 6) ^ rotate(s[4], 11) ^ rotate(s[4], 25);
      const std::uint32_t first = s[7] + e + ((s[4] & s[5]) ^ (~s[4] & s[6])) + k[i] + w[i];
      const std::uint32_t a = rotate(s[0], 2) ^ rotate(s[0], 13) ^ rotate(s[0], 22);
      const std::uint32_t second = a + ((s[0] & s[1]) ^ (s[0] & s[2]) ^ (s[1] & s[2]));
      s = {first + second, s[0], s[1], s[2], s[3] + first, s[4], s[5], s[6]};
    }
    for (std::size_t i = 0; i < 8; ++i) h[i] += s[i];
  }
  std::string digest;
  for (const std::uint32_t word : h)
    for (int shift = 24; shift >= 0; shift -= 8) digest += static_cast<char>(word >> shift & 0xFF);
  return digest;
}

// HMAC-SHA-256 (RFC 2104) with a key of at most 64 bytes.
inline std::string hmac(std::string key, std::string_view message) {
  key.resize(64, '\0');
  std::string inner = key, outer = std::move(key);
  for (char& c : inner) c = static_cast<char>(c ^ 0x36);
  for (char& c : outer) c = static_cast<char>(c ^ 0x5c);
  return sha256(outer + sha256(inner.append(message)));
}

inline std::string hex(std::string_view bytes) {
  std::string digits;
  for (const char c : bytes)
    for (const int shift : {4, 0}) digits += "0123456789abcdef"[static_cast<unsigned char>(c) >> shift & 0xF];
  return digits;
}

inline bool equal(std::string_view a, std::string_view b) {  // in constant time
  unsigned difference = a.size() == b.size() ? 0 : 1;
  for (std::size_t i = 0; i < std::min(a.size(), b.size()); ++i) difference |= static_cast<unsigned char>(a[i] ^ b[i]);
  return difference == 0;
}

inline std::string random_bytes(std::size_t count) {
  std::string bytes(count, '\0');
  if (getentropy(bytes.data(), count) != 0) throw Error("no random numbers");
  return bytes;
}

inline std::string read_key(const std::string& path) {
  struct stat status {};
  std::ifstream file(path);
  std::string digits;
  if (!(file >> digits) || stat(path.c_str(), &status) != 0) throw Error(path + ": the key cannot be read");
  if ((status.st_mode & 0077) != 0) throw Error(path + ": only its owner may have access to a key; chmod 600 the file");
  std::string key;
  for (std::size_t i = 0; i + 1 < digits.size(); i += 2) {
    unsigned byte = 0;
    const auto [rest, error] = std::from_chars(digits.data() + i, digits.data() + i + 2, byte, 16);
    if (error != std::errc() || rest != digits.data() + i + 2) break;
    key += static_cast<char>(byte);
  }
  if (digits.size() != kDigits || key.size() != kDigits / 2) throw Error(path + ": not a key, which has 64 hexadecimal digits");
  return key;
}

// Splits off the text before the next space.
inline std::string_view word(std::string_view& rest) {
  const std::size_t end = rest.find(' ');
  const std::string_view found = rest.substr(0, end);
  rest.remove_prefix(end == std::string_view::npos ? rest.size() : end + 1);
  return found;
}

inline std::int64_t number(std::string_view digits) {
  std::int64_t value = 0;
  const auto [rest, error] = std::from_chars(digits.data(), digits.data() + digits.size(), value);
  if (error != std::errc() || rest != digits.data() + digits.size() || value < 0) throw Lost("not a relay of tsgt");
  return value;
}

// The offset from another clock to ours: the smallest difference between arrival and origin. What a line takes beyond that
// is delay. The offset may grow with the skew of two clocks.
class LeastDelay {
 public:
  bool known() const { return known_; }
  void sample(std::int64_t origin, std::int64_t arrived) {
    std::int64_t offset = sum(arrived, -origin);
    if (known_) offset = std::min(offset, sum(offset_, std::max<std::int64_t>(0, sum(arrived, -at_)) / 5000));
    offset_ = offset, at_ = arrived, known_ = true;
  }
  std::int64_t here(std::int64_t origin) const { return sum(origin, offset_); }

 private:
  bool known_ = false;
  std::int64_t offset_ = 0, at_ = 0;
};

template <std::size_t N>
std::optional<std::array<double, N>> numbers(const json::Value& value) {
  if (value.is_null()) return std::nullopt;
  const auto& items = value.array();
  if (items.size() != N) throw std::invalid_argument("a list of another length");
  std::array<double, N> result{};
  std::transform(items.begin(), items.end(), result.begin(), [](const json::Value& item) { return item.number(); });
  return result;
}

// A time in ns, whose negative fits as well.
inline std::int64_t time(const json::Value& value) {
  const std::int64_t nanoseconds = value.integer();
  if (nanoseconds < -INT64_MAX) throw std::invalid_argument("a time beyond 64 bits");
  return nanoseconds;
}

inline std::optional<double> optional_number(const json::Value& value) {
  return value.is_null() ? std::nullopt : std::optional<double>(value.number());
}

inline std::optional<std::int64_t> optional_integer(const json::Value& value) {
  return value.is_null() ? std::nullopt : std::optional<std::int64_t>(value.integer());
}

}  // namespace detail

// ---------------------------------------------------------------------------------------------------------------------

class Stream {
 public:
  // `source`: path of a UNIX socket, or relay://HOST[:PORT] with the file of the relay's key. `resume`: whether to ask a relay
  // for the lines that were missed while there was no connection.
  explicit Stream(const std::string& source, const std::string& key_file = "", bool resume = true)
      : source_(source), resume_(resume) {
    const std::string scheme = "relay://";
    if (source.rfind(scheme, 0) == 0) {
      std::string host = source.substr(scheme.size());
      port_ = "27690";
      const std::size_t colon = host.rfind(':');
      if (colon != std::string::npos && (host[0] != '[' || host[colon - 1] == ']')) {
        port_ = host.substr(colon + 1);
        host.resize(colon);
      }
      if (host.size() > 2 && host[0] == '[') host = host.substr(1, host.size() - 2);
      host_ = host;
      key_ = detail::read_key(key_file);
    } else if (source.find("://") != std::string::npos) {
      throw Error(source + ": expected the path of a socket or relay://HOST:PORT; for TLS use `ssh -L` here");
    }
  }

  Stream(const Stream&) = delete;
  Stream& operator=(const Stream&) = delete;
  ~Stream() { disconnect(); }

  // The next record; nothing if none arrives in time. Throws Error where another attempt does not help.
  std::optional<Record> next(std::chrono::milliseconds timeout) {
    const std::int64_t until = monotonic_ns() + timeout.count() * 1000000;
    while (records_.empty()) {
      step(until);
      if (records_.empty() && monotonic_ns() >= until) return std::nullopt;
    }
    Record record = std::move(records_.front());
    records_.pop_front();
    return record;
  }

  // The newest live pose (predicted or interpolated); null while it is older or invalid. Reads what has arrived, without
  // waiting, and drops all other records: use either this or next().
  const Pose* latest(double max_age_s) {
    do step(monotonic_ns());
    while (more_);
    records_.clear();
    return latest_ && latest_->valid && latest_->age_s() <= max_age_s ? &*latest_ : nullptr;
  }

  // Why there is no connection; empty while there is one.
  const std::string& problem() const { return problem_; }

 private:
  bool over_relay() const { return !key_.empty(); }

  void step(std::int64_t until) {
    more_ = false;
    try {
      if (socket_ < 0) {
        wait(-1, 0, std::min(until, retry_));
        if (monotonic_ns() < retry_) return;
        connect();
      }
      if (!connecting_ || connected(until)) receive(until);
    } catch (const detail::Lost& lost) {
      disconnect();
      caught_up_ = true;  // nothing more will tell the age of what is held
      release();
      failures_at_key_ = at_key_ ? failures_at_key_ + 1 : 0;  // the first time, the relay may have been busy
      const std::string reason = full_ ? "the relay has too many readers" : lost.what();
      at_key_ = full_ = false;
      if (failures_at_key_ >= 2 && !was_ready_) throw Error(source_ + ": the relay has another key, or has seen too many wrong ones");
      problem_ = source_ + ": " + reason;
      retry_ = monotonic_ns() + back_off_;
      back_off_ = std::min(2 * back_off_, detail::kMaxBackOff);
    }
  }

  static bool wait(int descriptor, short events, std::int64_t until) {
    pollfd waiting{descriptor, events, 0};
    const std::int64_t left = std::max<std::int64_t>(0, until - monotonic_ns());
    return poll(&waiting, descriptor < 0 ? 0 : 1, static_cast<int>(std::min<std::int64_t>(left / 1000000 + (left > 0), 1000))) > 0;
  }

  [[noreturn]] static void fail(int code) { throw detail::Lost(std::strerror(code)); }

  void connect() {
    at_key_ = ready_ = false;
    challenge_.clear(), request_.clear(), received_.clear();
    if (!over_relay()) {
      sockaddr_un address{};
      address.sun_family = AF_UNIX;
      if (source_.size() >= sizeof(address.sun_path)) throw Error(source_ + ": the path is too long for a socket");
      std::memcpy(address.sun_path, source_.c_str(), source_.size() + 1);
      open(AF_UNIX, reinterpret_cast<const sockaddr*>(&address), sizeof(address));
    } else {
      addrinfo hints{};
      hints.ai_socktype = SOCK_STREAM;
      addrinfo* found = nullptr;
      const int error = getaddrinfo(host_.c_str(), port_.c_str(), &hints, &found);
      if (error != 0) throw detail::Lost(gai_strerror(error));
      int count = 0;
      for (const addrinfo* each = found; each != nullptr; each = each->ai_next) ++count;
      const addrinfo* chosen = found;  // all in turn: a name may have addresses at which the relay does not listen
      for (int i = attempts_++ % count; i > 0; --i) chosen = chosen->ai_next;
      const addrinfo address = *chosen;
      sockaddr_storage storage{};
      std::memcpy(&storage, address.ai_addr, address.ai_addrlen);
      freeaddrinfo(found);
      open(address.ai_family, reinterpret_cast<const sockaddr*>(&storage), address.ai_addrlen);
    }
    heard_ = empty_ = monotonic_ns();
    if (!over_relay()) ++connections_;
  }

  void open(int family, const sockaddr* address, socklen_t size) {
    socket_ = socket(family, SOCK_STREAM | SOCK_NONBLOCK | SOCK_CLOEXEC, 0);
    if (socket_ < 0) fail(errno);
    connecting_ = ::connect(socket_, address, size) != 0;
    if (connecting_ && errno != EINPROGRESS) fail(errno);
  }

  bool connected(std::int64_t until) {
    const std::int64_t deadline = heard_ + detail::kConnectTimeout;
    if (!wait(socket_, POLLOUT, std::min(until, deadline))) {
      if (monotonic_ns() >= deadline) throw detail::Lost("nothing answers");
      return false;
    }
    int code = 0;
    socklen_t length = sizeof(code);
    getsockopt(socket_, SOL_SOCKET, SO_ERROR, &code, &length);
    if (code != 0) fail(code);
    connecting_ = false;
    return true;
  }

  void disconnect() {
    if (socket_ >= 0) close(socket_);
    socket_ = -1;
    ready_ = connecting_ = false;
  }

  void receive(std::int64_t until) {
    std::array<char, 65536> data;
    const ssize_t count = recv(socket_, data.data(), data.size(), 0);
    if (count == 0) throw detail::Lost("the stream has ended");
    if (count < 0) {
      if (errno != EAGAIN && errno != EWOULDBLOCK && errno != EINTR) fail(errno);
      const std::int64_t now = monotonic_ns(), silent = heard_ + (ready_ ? detail::kSilenceTimeout : detail::kConnectTimeout);
      if (over_relay() && now >= silent)
        throw detail::Lost("nothing received for " + std::to_string((silent - heard_) / detail::kSecond) + " s; check the network and the relay");
      emptied(now);
      if (!records_.empty()) return;
      if (over_relay()) until = std::min(until, silent);
      wait(socket_, POLLIN, caught_up_ || !steady_ ? until : std::min(until, steady_until()));
      return;
    }
    heard_ = monotonic_ns();
    if (heard_ - empty_ > detail::kMaxPause) fall_behind();
    more_ = true;
    received_.append(data.data(), static_cast<std::size_t>(count));
    std::size_t start = 0;
    for (std::size_t end; (end = received_.find('\n', start)) != std::string::npos; start = end + 1)
      take(std::string_view(received_).substr(start, end - start));
    received_.erase(0, start);
    if (ready_ && !full_) {
      was_ready_ = true;
      problem_.clear();
      back_off_ = detail::kFirstBackOff;
    }
    if (received_.size() > (over_relay() && !ready_ ? detail::kMaxHandshake : detail::kMaxLine))
      throw detail::Lost("a line is too long: not a stream of tsgt");
    release();
  }

  // Poses wait in held_ until it is known how old they are. The offset of the clocks comes from lines that were read as soon as
  // they arrived; of lines that piled up while the program was busy, each would be new by its own offset. So all that has piled
  // up is read first, and the newest line dates it. An empty socket alone does not tell that, for the master sends the rest of
  // its queue as the reader makes room.

  void fall_behind() {
    caught_up_ = false;
    steady_.reset();
  }

  // An upper bound, from the master's clock to ours.
  std::int64_t offset() const {
    if (!session_.known()) return detail::kNoOffset;
    return over_relay() ? network_.here(session_.here(0)) : session_.here(0);
  }

  std::int64_t steady_until() const {
    return steady_->first + (steady_->second == detail::kNoOffset ? detail::kUnknown : detail::kSteady);
  }

  // All that had arrived has been read.
  void emptied(std::int64_t now) {
    const bool prompt = now - empty_ <= detail::kPrompt;
    empty_ = now;
    const std::int64_t offset_now = offset();
    if (caught_up_ || (offset_now == detail::kNoOffset && held_.empty())) return;
    if (!steady_ || offset_now < detail::sum(steady_->second, -detail::kSteady)) {
      caught_up_ = prompt && !steady_ && offset_now != detail::kNoOffset;
      steady_ = {now, offset_now};
    } else if (now >= steady_until()) {
      caught_up_ = true;
    }
    release();
  }

  void release() {
    while (!held_.empty() &&
           (caught_up_ || held_.size() > detail::kMaxHeld || !std::holds_alternative<Pose>(held_.front()))) {
      if (auto* pose = std::get_if<Pose>(&held_.front())) {
        if (session_.known()) pose->epoch_ns = session_.here(pose->stamp_ns);
        if (over_relay()) pose->epoch_ns = network_.here(pose->epoch_ns);
        if (pose->kind == "predicted" || pose->kind == "interpolated") latest_ = *pose;
      }
      records_.push_back(std::move(held_.front()));
      held_.pop_front();
    }
  }

  void take(std::string_view line) {
    if (!over_relay()) {
      if (!ready_ && connections_ > 1) gap(std::nullopt, "the connection to the master was lost");
      ready_ = true;
      decode(line, heard_);
    } else if (ready_) {
      frame(line);
    } else if (challenge_.empty()) {
      answer(line);
    } else {
      welcome(line);
    }
  }

  void answer(std::string_view line) {
    const std::string prefix = std::string(detail::kRelay) + " ";
    if (line.substr(0, 11) != "tsgt-relay ") throw detail::Lost("no relay of tsgt answers there, or it uses TLS");
    if (line.substr(0, prefix.size()) != prefix) throw detail::Lost("the relay has another protocol version than 1");
    challenge_ = line;
    const bool place = resume_ && !stream_.empty();
    request_ = detail::hex(detail::random_bytes(32)) + " " + (place ? stream_ + " " + std::to_string(next_) : "- -");
    request_ += " " + proof("reader", challenge_ + "\n" + request_);
    at_key_ = true;
    const std::string sent = request_ + "\n";  // shorter than any send buffer
    if (send(socket_, sent.data(), sent.size(), MSG_NOSIGNAL) != static_cast<ssize_t>(sent.size())) fail(errno);
  }

  void welcome(std::string_view line) {
    const std::size_t space = line.rfind(' ');
    if (space == std::string_view::npos ||
        !detail::equal(line.substr(space + 1), proof("relay", challenge_ + "\n" + request_ + "\n" + std::string(line.substr(0, space)))))
      throw detail::Lost("the relay does not have the key");
    std::string_view rest = line;
    const std::string stream(detail::word(rest));
    const std::int64_t first = detail::number(detail::word(rest)), relay_ns = detail::number(detail::word(rest));
    at_key_ = false;
    if (stream != stream_) {
      if (!stream_.empty()) gap(std::nullopt, "the relay was restarted");
      network_ = detail::LeastDelay();
      last_beat_ = 0;
    } else if (first > next_) {
      gap(first - next_, "the relay no longer holds these lines");
    } else if (first < next_) {
      throw detail::Lost("the relay goes back");
    }
    network_.sample(relay_ns, heard_);
    stream_ = stream, next_ = first;
    line_key_ = detail::hmac(key_, std::string(detail::kRelay) + " lines\n" + stream_);
    ready_ = true;
  }

  void frame(std::string_view line) {
    const std::string_view tag = line.substr(0, 32);
    std::string_view rest = line.substr(std::min<std::size_t>(33, line.size()));
    if (!detail::equal(tag, detail::hex(detail::hmac(line_key_, rest)).substr(0, 32)))
      throw detail::Lost("a line was changed on its way from the relay");
    const std::string_view kind = detail::word(rest);
    const std::int64_t at = detail::number(detail::word(rest)), time = detail::number(detail::word(rest));
    if (at < next_) throw detail::Lost("the relay repeats a line");
    if (kind == "beat" && time <= last_beat_) throw detail::Lost("the relay repeats a sign of life");
    if (kind == "beat") last_beat_ = time, full_ = full_ || rest == "full";
    if (kind != "head") network_.sample(time, heard_);
    if (at > next_) gap(at - next_, "this reader was too slow for the relay");
    next_ = at + (kind == "line" ? 1 : 0);
    if (kind == "line" && greeted_ && rest.substr(0, 15) == "{\"type\":\"hello\"")
      gap(std::nullopt, "the relay had lost its connection to the master");
    if (kind != "beat") decode(rest, time);
  }

  std::string proof(const char* role, const std::string& lines) const {
    return detail::hex(detail::hmac(key_, std::string(detail::kRelay) + " " + role + "\n-\n" + lines));
  }

  void gap(std::optional<std::int64_t> lines, const std::string& reason) { held_.emplace_back(Gap{lines, reason}); }

  void decode(std::string_view text, std::int64_t arrived) {
    try {
      const json::Value line = json::Parser(text).parse();
      const std::string& type = line["type"].text();
      if (type == "hello") {
        if (line["protocol"].integer() != detail::kProtocol) throw Error(source_ + ": the stream has another protocol version than 1");
        greeted_ = caught_up_ = true;
        release();  // by the clock of the session that they are of
        fall_behind();
        session_ = detail::LeastDelay();  // the Unix clock of the next session may differ
        latest_.reset();
        held_.emplace_back(Hello{line["version"].text()});
        return;
      }
      if (!greeted_) throw std::invalid_argument("no greeting");
      const bool predicted = type == "pose" && line["kind"].text() == "predicted";
      if (predicted || type == "status" || type == "event") session_.sample(detail::time(line["stamp_ns"]), arrived);
      if (type == "measurement" || type == "point") session_.sample(detail::time(line["received_ns"]), arrived);
      if (type == "pose") {
        pose(line, arrived);
      } else if (type == "event") {
        Event event{detail::time(line["stamp_ns"]), line["event"].text(), line["message"].text(),
                    detail::optional_integer(line["station"]), detail::optional_integer(line["count"])};
        const bool lost = event.event == "lines_lost";
        const auto count = event.count;
        held_.emplace_back(std::move(event));
        if (lost) gap(count, "this reader was too slow for the master");
      } else {
        held_.emplace_back(Other{type, line});
      }
    } catch (const std::invalid_argument& error) {
      if (!greeted_) throw Error(source_ + ": not a stream of tsgt");
      gap(1, std::string("a line cannot be used: ") + error.what());
    }
  }

  void pose(const json::Value& line, std::int64_t arrived) {
    Pose pose;
    pose.stamp_ns = detail::time(line["stamp_ns"]);
    pose.frame = line["frame"].text();
    pose.child_frame = line["child_frame"].text();
    pose.estimator = line["estimator"].text();
    pose.kind = line["kind"].text();
    pose.reason = line["reason"].text();
    if (!line["quality"].is_null()) pose.quality = line["quality"].text();
    pose.delay_s = detail::optional_number(line["delay_s"]);
    pose.valid = line["valid"].boolean();
    pose.position_m = detail::numbers<3>(line["position_m"]);
    pose.orientation_xyzw = detail::numbers<4>(line["orientation_xyzw"]);
    pose.covariance = detail::numbers<36>(line["covariance"]);
    pose.covariance_common = detail::numbers<36>(line["covariance_common"]);
    pose.velocity_mps = detail::numbers<3>(line["velocity_mps"]);
    pose.angular_velocity_radps = detail::numbers<3>(line["angular_velocity_radps"]);
    pose.residual_m = detail::optional_number(line["residual_m"]);
    pose.epoch_ns = arrived;  // until it is dated
    held_.emplace_back(std::move(pose));
  }

  std::string source_, host_, port_, key_, line_key_, stream_, challenge_, request_, received_, problem_;
  bool resume_, connecting_ = false, more_ = false, ready_ = false, was_ready_ = false, at_key_ = false, greeted_ = false;
  bool full_ = false;  // the relay has said that it has too many readers, and ends the connection
  bool caught_up_ = false;
  int socket_ = -1, connections_ = 0, failures_at_key_ = 0, attempts_ = 0;
  std::int64_t next_ = 0, last_beat_ = 0, heard_ = 0, empty_ = 0, retry_ = 0, back_off_ = detail::kFirstBackOff;
  detail::LeastDelay session_, network_;
  std::optional<std::pair<std::int64_t, std::int64_t>> steady_;  // since when the offset has stayed the same, and the offset
  std::deque<Record> held_, records_;
  std::optional<Pose> latest_;
};

}  // namespace tsgt

#endif  // TSGT_STREAM_HPP
