// A client by the reference implementation of OpenIGTLink: igtl_client PORT SECONDS
//
// Prints a line for each message: type, device, stamp, whether the checksum is right; of words the words, of a transform
// its twelve numbers, of a surface the number of points and triangles, sums over the coordinates and corner indices, and
// the first point.

#include <chrono>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <cstring>

#include "igtlClientSocket.h"
#include "igtlMessageHeader.h"
#include "igtlPolyDataMessage.h"
#include "igtlStringMessage.h"
#include "igtlTransformMessage.h"

namespace {

template <typename Message>
typename Message::Pointer body(igtl::ClientSocket* socket, igtl::MessageHeader* header) {
  typename Message::Pointer message = Message::New();
  message->SetMessageHeader(header);
  message->AllocatePack();
  socket->Receive(message->GetPackBodyPointer(), message->GetPackBodySize());
  const int status = message->Unpack(1);  // 1: check the checksum
  std::printf(" %s", status & igtl::MessageHeader::UNPACK_BODY ? "checked" : "wrong");
  return message;
}

void show(igtl::PolyDataMessage* surface) {
  igtl::PolyDataPointArray* points = surface->GetPoints();
  igtl::PolyDataCellArray* polygons = surface->GetPolygons();
  double sums[3] = {0.0, 0.0, 0.0};
  igtlFloat32 point[3] = {0.0F, 0.0F, 0.0F};
  for (int i = 0; i < points->GetNumberOfPoints(); ++i) {
    points->GetPoint(i, point);
    for (int axis = 0; axis < 3; ++axis) sums[axis] += point[axis];
  }
  points->GetPoint(0, point);
  double corners = 0.0;
  for (igtlUint32 i = 0; i < polygons->GetNumberOfCells(); ++i) {
    if (polygons->GetCellSize(i) != 3) std::exit(3);
    igtlUint32 cell[3];
    polygons->GetCell(i, cell);
    corners += cell[0] + 2.0 * cell[1] + 3.0 * cell[2];
  }
  std::printf(" %d %u %.6f %.6f %.6f %.1f %.6f %.6f %.6f", points->GetNumberOfPoints(), polygons->GetNumberOfCells(),
              sums[0], sums[1], sums[2], corners, point[0], point[1], point[2]);
}

}  // namespace

int main(int argc, char** argv) {
  if (argc != 3) return 2;
  igtl::ClientSocket::Pointer socket = igtl::ClientSocket::New();
  if (socket->ConnectToServer("127.0.0.1", std::atoi(argv[1])) != 0) return 1;
  socket->SetReceiveTimeout(2000);
  const auto end = std::chrono::steady_clock::now() + std::chrono::duration<double>(std::atof(argv[2]));
  igtl::MessageHeader::Pointer header = igtl::MessageHeader::New();
  while (std::chrono::steady_clock::now() < end) {
    header->InitPack();
    if (socket->Receive(header->GetPackPointer(), header->GetPackSize()) != header->GetPackSize()) break;
    header->Unpack();
    igtl::TimeStamp::Pointer stamp = igtl::TimeStamp::New();
    header->GetTimeStamp(stamp);
    std::printf("%s|%s|%.6f|", header->GetDeviceType(), header->GetDeviceName(), stamp->GetTimeStamp());
    if (std::strcmp(header->GetDeviceType(), "POLYDATA") == 0) {
      show(body<igtl::PolyDataMessage>(socket, header));
    } else if (std::strcmp(header->GetDeviceType(), "TRANSFORM") == 0) {
      igtl::Matrix4x4 matrix;
      body<igtl::TransformMessage>(socket, header)->GetMatrix(matrix);
      for (int row = 0; row < 3; ++row)
        for (int column = 0; column < 4; ++column) std::printf(" %.6f", matrix[row][column]);
    } else if (std::strcmp(header->GetDeviceType(), "STRING") == 0) {
      std::printf(" %s", body<igtl::StringMessage>(socket, header)->GetString());
    } else {
      return 4;
    }
    std::printf("\n");
    std::fflush(stdout);
  }
  socket->CloseSocket();
  return 0;
}
