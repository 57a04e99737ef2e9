#include "library/pgccd.h"

#include <algorithm>
#include <atomic>
#include <bit>
#include <cmath>
#include <cstddef>
#include <cstdio>
#include <cstring>
#include <fstream>
#include <limits>
#include <memory>
#include <stdexcept>
#include <string>
#include <vector>

#include "kernels/arms/scene_checks.h"
#include "kernels/arms/validator.h"

namespace {

using namespace pgccd;

enum TableType : int32_t { kUint8, kInt32, kInt64, kFloat32, kFloat64 };
constexpr int64_t kTypeBytes[] = {1, 4, 8, 4, 8};

// In the order of the operators' arguments `mesh_set`, `arm`, `bodies` and `obstacles`.
enum TableName : int32_t {
  kVertices,
  kFaces,
  kEdges,
  kTriangles,
  kNodeBlocks,
  kNodeLinks,
  kLeafPoints,
  kCorners,
  kOffsets,
  kCentres,
  kReaches,
  kNodeSupports,
  kBoxes,
  kIsSolid,
  kPieceBegin,
  kPieceVertex,
  kJoints,
  kPlaces,
  kCrossing,
  kChainBegin,
  kChain,
  kBodyReach,
  kMeshIndex,
  kRadius,
  kMargin,
  kPairs,
  kPositionT0,
  kPositionT1,
  kOrientation,
  kRotation,
  kError,
  kTables
};

[[noreturn]] void refuse(int32_t table, const std::string& why) {
  throw std::invalid_argument("table " + std::to_string(table) + ": " + why);
}

// Rows of a table, of `width` elements each; sets their number if it is asked for.
class Tables {
 public:
  Tables(const pgccd_table* tables, int32_t count) : tables_(tables) {
    if (count != kTables) throw std::invalid_argument("expected " + std::to_string(kTables) + " tables");
  }

  template <class Row>
  const Row* rows(TableName name, TableType type, int64_t width, int64_t count = -1) const {
    const pgccd_table& table = tables_[name];
    if (table.type != type) refuse(name, "wrong type");
    if (elements(name) != width * size(name)) refuse(name, "wrong shape");
    if (count >= 0 && size(name) != count) refuse(name, "wrong number of rows");
    if (reinterpret_cast<uintptr_t>(table.data) % alignof(Row) != 0) refuse(name, "not aligned");
    return static_cast<const Row*>(table.data);
  }
  int64_t size(TableName name) const { return tables_[name].dimensions == 0 ? 0 : tables_[name].shape[0]; }
  int64_t elements(TableName name) const {
    int64_t product = 1;
    for (int32_t k = 0; k < tables_[name].dimensions; ++k) product *= tables_[name].shape[k];
    return product;
  }
  const int64_t* shape(TableName name) const { return tables_[name].shape; }

 private:
  const pgccd_table* tables_;
};

template <class T>
T or_null(T pointer, int64_t count) {
  return count == 0 ? nullptr : pointer;
}

MeshSetView meshes_of(const Tables& t) {
  MeshSetView view{};
  const int64_t faces = t.size(kFaces), blocks = t.size(kNodeBlocks);
  view.mesh_count = t.size(kOffsets) - 1;
  if (view.mesh_count < 1) refuse(kOffsets, "expected two rows or more");
  view.vertices = t.rows<double>(kVertices, kFloat64, 3);
  view.faces = t.rows<int32_t>(kFaces, kInt32, 3);
  view.edges = t.rows<int32_t>(kEdges, kInt32, 2);
  view.triangles = t.rows<Triangle>(kTriangles, kInt32, 8, faces);
  view.node_blocks = t.rows<NodeBlock>(kNodeBlocks, kFloat32, kBlockColumns * kBlockWidth);
  view.node_links = t.rows<NodeLink>(kNodeLinks, kInt32, 4 * kBlockWidth, blocks);
  view.node_supports = t.rows<NodeSupport>(kNodeSupports, kInt32, kSupportWords * kBlockWidth, blocks);
  view.leaf_points = t.rows<LeafPoints>(kLeafPoints, kInt32, 4 * kBlockWidth);
  const int64_t stride = t.shape(kCorners)[1];
  view.corners = {t.rows<float>(kCorners, kFloat32, stride, 9), stride, stride - kMaxLeafTriangles != faces};
  view.offsets = t.rows<MeshOffsets>(kOffsets, kInt64, 6);
  view.feature_count = std::max({t.size(kVertices), faces, t.size(kEdges)});
  const MeshOffsets &last = view.offsets[view.mesh_count], &first = view.offsets[0];
  const bool is_whole = last.vertex == t.size(kVertices) && last.face == faces && last.edge == t.size(kEdges) &&
                        last.block == blocks && last.leaf_points == t.size(kLeafPoints) &&
                        last.corners == stride - kMaxLeafTriangles && first.vertex == 0 && first.face == 0;
  if (!is_whole) refuse(kOffsets, "not the sizes of the others");
  const auto of_meshes = [&](TableName name, int64_t more) { return t.size(name) == 0 ? 0 : view.mesh_count + more; };
  view.centres = or_null(t.rows<double>(kCentres, kFloat64, 3, of_meshes(kCentres, 0)), t.size(kCentres));
  view.reaches = or_null(t.rows<double>(kReaches, kFloat64, 1, t.size(kCentres)), t.size(kCentres));
  view.boxes = or_null(t.rows<double>(kBoxes, kFloat64, 12, of_meshes(kBoxes, 0)), t.size(kBoxes));
  if (t.size(kIsSolid) > 0) {
    view.solids = {t.rows<uint8_t>(kIsSolid, kUint8, 1, view.mesh_count),
                   t.rows<int64_t>(kPieceBegin, kInt64, 1, view.mesh_count + 1),
                   t.rows<int32_t>(kPieceVertex, kInt32, 1)};
  }
  return view;
}

Arm arm_of(const Tables& t, double room) {
  Arm arm{};
  arm.joint_count = t.size(kJoints);
  arm.joints = t.rows<Joint>(kJoints, kInt32, kJointColumns);
  arm.places = t.rows<JointPlace>(kPlaces, kFloat64, kPlaceColumns, arm.joint_count);
  arm.crossing = t.rows<double>(kCrossing, kFloat64, arm.joint_count, arm.joint_count);
  arm.body_count = t.size(kChainBegin) - 1;
  if (arm.body_count < 0) refuse(kChainBegin, "expected one row or more");
  arm.chain_begin = t.rows<int32_t>(kChainBegin, kInt32, 1);
  arm.chain = t.rows<int32_t>(kChain, kInt32, 1);
  arm.body_reach = t.rows<double>(kBodyReach, kFloat64, 1, arm.body_count);
  arm.room = room;
  for (int64_t k = 0; k < arm.joint_count; ++k) {
    arm.coordinate_count = std::max<int64_t>(arm.coordinate_count, arm.joints[k].coordinate + 1);
  }
  return arm;
}

ArmScene scene_of(const Tables& t, double room) {
  ArmScene scene{};
  scene.meshes = meshes_of(t);
  scene.arm = arm_of(t, room);
  ArmObstacles& obstacles = scene.obstacles;
  obstacles.row_count = 1;
  obstacles.count = t.size(kError);
  obstacles.position_t0 = t.rows<double>(kPositionT0, kFloat64, 3 * obstacles.count, 1);
  obstacles.position_t1 = t.rows<double>(kPositionT1, kFloat64, 3 * obstacles.count, 1);
  obstacles.orientation = t.rows<double>(kOrientation, kFloat64, 4 * obstacles.count, 1);
  obstacles.rotation = t.rows<double>(kRotation, kFloat64, 3 * obstacles.count, 1);
  obstacles.error = t.rows<double>(kError, kFloat64, 1);
  const int64_t count = scene.arm.body_count + obstacles.count;
  scene.mesh_index = t.rows<int32_t>(kMeshIndex, kInt32, 1, count);
  scene.radius = t.rows<double>(kRadius, kFloat64, 1, count);
  scene.margin = t.rows<double>(kMargin, kFloat64, 1, count);
  scene.pairs = t.rows<ArmPair>(kPairs, kInt32, kArmPairColumns);
  scene.pair_count = t.size(kPairs);
  require_sound(scene, t.size(kChain));
  return scene;
}

// A file: these words, the sum of all that follows, room and resolution, and for each table type, number of dimensions
// and shape; then their contents, each from a multiple of 64 bytes on.
constexpr char kMagic[16] = "pgccd motion 1\n";
struct FileHead {
  char magic[16];
  uint64_t sum;
  double room, resolution;
  int64_t tables;
};
struct FileTable {
  int64_t type, dimensions, shape[3], begin;
};

uint64_t sum_of(const char* bytes, size_t count) {  // FNV-1a, of words
  uint64_t sum = 0xcbf29ce484222325u;
  for (size_t k = 0; k < count; k += 8) {
    uint64_t word = 0;
    std::memcpy(&word, bytes + k, std::min<size_t>(8, count - k));
    sum = (sum ^ word) * 0x100000001b3u;
    sum ^= sum >> 32;
  }
  return sum;
}

void write_message(const char* text, char* message, size_t size) {
  if (message == nullptr || size == 0) return;
  std::snprintf(message, size, "%s", text);
}

}  // namespace

struct pgccd_validator {
  std::shared_ptr<const std::vector<std::max_align_t>> file;  // null if the caller owns the tables
  std::vector<pgccd_table> tables;
  double room, resolution;
  MotionValidator search;
  std::atomic_flag is_busy = ATOMIC_FLAG_INIT;
};

namespace {

// Marks a validator as used while it lives.
class Use {
 public:
  explicit Use(pgccd_validator& validator) : validator_(validator), is_first_(!validator.is_busy.test_and_set()) {}
  ~Use() {
    if (is_first_) validator_.is_busy.clear();
  }
  bool is_first() const { return is_first_; }

 private:
  pgccd_validator& validator_;
  bool is_first_;
};

pgccd_validator* made(std::shared_ptr<const std::vector<std::max_align_t>> file, const pgccd_table* tables,
                      int32_t count, double room, double resolution) {
  if (!(resolution > 0.0 && resolution <= 1e150)) throw std::invalid_argument("resolution: expected a length > 0");
  if (!(room >= 0.0)) throw std::invalid_argument("room: expected a length >= 0");
  const MotionValidator search(scene_of(Tables(tables, count), room), resolution);
  return new pgccd_validator{std::move(file), {tables, tables + count}, room, resolution, search};
}

pgccd_validator* loaded(const char* path) {
  std::ifstream in(path, std::ios::binary | std::ios::ate);
  if (!in) throw std::runtime_error(std::string(path) + ": cannot be read");
  const auto size = static_cast<size_t>(in.tellg());
  auto file = std::make_shared<std::vector<std::max_align_t>>(size / sizeof(std::max_align_t) + 1);
  char* const bytes = reinterpret_cast<char*>(file->data());
  in.seekg(0);
  in.read(bytes, static_cast<std::streamsize>(size));
  FileHead head{};
  const std::string name(path);
  if (!in || size < sizeof(head)) throw std::runtime_error(name + ": too short for a validator");
  std::memcpy(&head, bytes, sizeof(head));
  if (std::memcmp(head.magic, kMagic, sizeof(kMagic)) != 0) {
    throw std::runtime_error(name + ": not a validator, or one of another version of pgccd");
  }
  constexpr size_t kSummed = offsetof(FileHead, sum) + sizeof(head.sum);
  if (head.sum != sum_of(bytes + kSummed, size - kSummed)) throw std::runtime_error(name + ": damaged");
  const size_t tables_end = sizeof(head) + kTables * sizeof(FileTable);
  if (head.tables != kTables || size < tables_end) throw std::runtime_error(name + ": damaged");
  std::vector<pgccd_table> tables(kTables);
  for (int k = 0; k < kTables; ++k) {
    FileTable given{};
    std::memcpy(&given, bytes + sizeof(head) + k * sizeof(given), sizeof(given));
    if (given.type < 0 || given.type > kFloat64 || given.dimensions < 1 || given.dimensions > 3) {
      throw std::runtime_error(name + ": damaged");
    }
    double count = static_cast<double>(kTypeBytes[given.type]);
    tables[k] = {bytes + given.begin, {}, static_cast<int32_t>(given.dimensions), static_cast<int32_t>(given.type)};
    for (int64_t d = 0; d < given.dimensions; ++d) {
      tables[k].shape[d] = given.shape[d];
      count *= given.shape[d] < 0 ? 1e300 : static_cast<double>(given.shape[d]);
    }
    if (given.begin < 0 || static_cast<double>(given.begin) + count > static_cast<double>(size)) {
      throw std::runtime_error(name + ": damaged");
    }
  }
  return made(file, tables.data(), kTables, head.room, head.resolution);
}

void save(const pgccd_validator& validator, const char* path) {
  FileHead head{{}, 0, validator.room, validator.resolution, kTables};
  std::memcpy(head.magic, kMagic, sizeof(kMagic));
  std::vector<char> bytes(sizeof(head) + kTables * sizeof(FileTable));
  for (int k = 0; k < kTables; ++k) {
    const pgccd_table& table = validator.tables[k];
    bytes.resize((bytes.size() + 63) / 64 * 64);
    FileTable entry{table.type, table.dimensions, {}, static_cast<int64_t>(bytes.size())};
    size_t size = static_cast<size_t>(kTypeBytes[table.type]);
    for (int d = 0; d < table.dimensions; ++d) size *= static_cast<size_t>(entry.shape[d] = table.shape[d]);
    std::memcpy(bytes.data() + sizeof(head) + k * sizeof(entry), &entry, sizeof(entry));
    const char* const data = static_cast<const char*>(table.data);
    bytes.insert(bytes.end(), data, data + size);
  }
  std::memcpy(bytes.data(), &head, sizeof(head));
  constexpr size_t kSummed = offsetof(FileHead, sum) + sizeof(head.sum);
  head.sum = sum_of(bytes.data() + kSummed, bytes.size() - kSummed);
  std::memcpy(bytes.data(), &head, sizeof(head));
  std::ofstream out(path, std::ios::binary);
  out.write(bytes.data(), static_cast<std::streamsize>(bytes.size()));
  out.close();
  if (!out) throw std::runtime_error(std::string(path) + ": cannot be written");
}

template <class Make>
pgccd_validator* or_message(Make&& make, char* message, size_t message_size) {
  try {
    return make();
  } catch (const std::exception& error) {
    write_message(error.what(), message, message_size);
    return nullptr;
  }
}

}  // namespace

pgccd_validator* pgccd_validator_new(const pgccd_table* tables, int32_t count, double room, double resolution,
                                     char* message, size_t message_size) {
  return or_message([&] { return made(nullptr, tables, count, room, resolution); }, message, message_size);
}

pgccd_validator* pgccd_validator_load(const char* path, char* message, size_t message_size) {
  return or_message([&] { return loaded(path); }, message, message_size);
}

int32_t pgccd_validator_save(const pgccd_validator* validator, const char* path, char* message, size_t message_size) {
  try {
    save(*validator, path);
    return 0;
  } catch (const std::exception& error) {
    write_message(error.what(), message, message_size);
    return -1;
  }
}

pgccd_validator* pgccd_validator_clone(const pgccd_validator* validator) {
  return new pgccd_validator{validator->file, validator->tables, validator->room, validator->resolution,
                             validator->search};
}

void pgccd_validator_free(pgccd_validator* validator) { delete validator; }

int32_t pgccd_coordinate_count(const pgccd_validator* validator) {
  return static_cast<int32_t>(validator->search.scene().arm.coordinate_count);
}

int32_t pgccd_body_count(const pgccd_validator* validator) {
  const ArmScene& scene = validator->search.scene();
  return static_cast<int32_t>(scene.arm.body_count + scene.obstacles.count);
}

int32_t pgccd_check_motion(pgccd_validator* validator, const double* start, const double* goal, int64_t budget,
                           pgccd_motion* motion) {
  const Use use(*validator);
  if (!use.is_first()) return PGCCD_BUSY;
  const int64_t most = budget > 0 ? budget : std::numeric_limits<int64_t>::max();
  const PathVerdict found = validator->search.check_motion(start, goal, most, motion != nullptr);
  if (motion != nullptr) {
    const bool is_free = found.verdict == Verdict::kFree;
    // A contact at the goal leaves less than the whole motion, however late it is.
    motion->free_until = is_free ? 1.0 : std::min(found.first.toi, std::nextafter(1.0, 0.0));
    const bool is_pair = found.first.pair >= 0;
    const ArmPair pair = is_pair ? validator->search.scene().pairs[found.first.pair] : ArmPair{-1, -1, 0};
    motion->bodies[0] = pair.first;
    motion->bodies[1] = pair.second;
    store_vec3(motion->point, found.point);
    motion->pair_spans = found.counts[kPairSpans];
  }
  return static_cast<int32_t>(found.verdict);
}

int32_t pgccd_check_states(pgccd_validator* validator, const double* states, int64_t count, uint8_t* valid) {
  const Use use(*validator);
  if (!use.is_first()) return PGCCD_BUSY;
  const int64_t width = validator->search.scene().arm.coordinate_count;
  for (int64_t k = 0; k < count; ++k) valid[k] = validator->search.check_state(states + k * width) ? 1 : 0;
  return 0;
}
