// A client of `kmn serve` in C++17 for POSIX systems: sends a depth image and its camera, prints the poses as JSON.
//
//     g++ -std=c++17 -O2 client.cpp -o client && ./client 127.0.0.1 8000 motor depth.png camera.json
#include <netdb.h>
#include <sys/socket.h>
#include <unistd.h>

#include <csignal>
#include <cstdio>
#include <cstdlib>
#include <fstream>
#include <iterator>
#include <stdexcept>
#include <string>

const std::string kBoundary = "kmn-3d1c9b54e0f7";  // must not occur in what is sent

std::string content(const std::string& path) {
  std::ifstream file(path, std::ios::binary);
  if (!file) throw std::runtime_error(path + " cannot be read");
  return {std::istreambuf_iterator<char>(file), {}};
}

// A field of the form; what comes with a file's name is a file, and the name's ending says its format.
std::string field(const std::string& name, const std::string& value, const std::string& file = "") {
  const std::string called = file.empty() ? "" : "; filename=\"" + file.substr(file.rfind('/') + 1) + "\"";
  const std::string head = "--" + kBoundary + "\r\nContent-Disposition: form-data; name=\"" + name + "\"" + called;
  return head + "\r\n\r\n" + value + "\r\n";
}

// Sends a request and returns the whole answer, after which the server closes the connection.
std::string ask(const std::string& host, const std::string& port, const std::string& request) {
  std::signal(SIGPIPE, SIG_IGN);  // a server that refuses a request may close before all of it is sent
  addrinfo hints{}, *found = nullptr;
  hints.ai_socktype = SOCK_STREAM;
  if (getaddrinfo(host.c_str(), port.c_str(), &hints, &found)) throw std::runtime_error(host + " is not known");
  int connection = -1;
  for (const addrinfo* one = found; one && connection < 0; one = one->ai_next) {  // localhost may have two addresses
    connection = socket(one->ai_family, one->ai_socktype, one->ai_protocol);
    if (connection >= 0 && connect(connection, one->ai_addr, one->ai_addrlen)) close(connection), connection = -1;
  }
  freeaddrinfo(found);
  if (connection < 0) throw std::runtime_error("no server answers at " + host + ":" + port);
  for (size_t sent = 0; sent < request.size();) {
    const ssize_t more = send(connection, request.data() + sent, request.size() - sent, 0);
    if (more <= 0) break;  // its answer says why
    sent += more;
  }
  std::string answer;
  char piece[65536];
  for (ssize_t size; (size = recv(connection, piece, sizeof piece, 0)) > 0;) answer.append(piece, size);
  close(connection);
  return answer;
}

int main(int count, char** given) try {
  if (count != 6) throw std::runtime_error("usage: client HOST PORT PART DEPTH.png CAMERA.json");
  const std::string host = given[1], port = given[2], part = given[3], depth = given[4], camera = given[5];
  const std::string body = field("part", part) + field("units", "mm") + field("camera", content(camera), camera) +
                           field("scene", content(depth), depth) + "--" + kBoundary + "--\r\n";
  const std::string head = "POST /detect HTTP/1.1\r\nHost: " + host + ":" + port + "\r\nConnection: close\r\n" +
                           "Content-Type: multipart/form-data; boundary=" + kBoundary + "\r\n" +
                           "Content-Length: " + std::to_string(body.size()) + "\r\n\r\n";
  const std::string answer = ask(host, port, head + body);
  const size_t end = answer.find("\r\n\r\n");
  if (end == std::string::npos) throw std::runtime_error("the server closed the connection without an answer");
  const bool is_found = answer.compare(0, 13, "HTTP/1.1 200 ") == 0;
  std::fprintf(is_found ? stdout : stderr, "%s\n", answer.c_str() + end + 4);  // poses, or a sentence: {"error": ...}
  return is_found ? EXIT_SUCCESS : EXIT_FAILURE;
} catch (const std::exception& error) {
  std::fprintf(stderr, "client: %s\n", error.what());
  return EXIT_FAILURE;
}
