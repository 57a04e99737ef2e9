#include "kernels/graphs/conditional.h"
#include "kernels/launch.cuh"

namespace pgccd {

#if CUDART_VERSION >= 13000  // earlier versions have other signatures

namespace {

__global__ void set_condition(cudaGraphConditionalHandle condition, const int64_t* value) {
  wait_for_previous_kernels();
  cudaGraphSetConditional(condition, *value != 0 ? 1 : 0);
}

// The graph into which a stream is being captured, and the nodes on which the next one depends.
struct Capture {
  cudaGraph_t graph = nullptr;
  const cudaGraphNode_t* nodes = nullptr;
  const cudaGraphEdgeData* edges = nullptr;
  size_t count = 0;

  explicit Capture(cudaStream_t stream) {
    cudaStreamCaptureStatus status = cudaStreamCaptureStatusNone;
    check_cuda(cudaStreamGetCaptureInfo(stream, &status, nullptr, &graph, &nodes, &edges, &count),
               "cudaStreamGetCaptureInfo");
    if (status != cudaStreamCaptureStatusActive) throw std::runtime_error("conditional: the stream is not captured");
  }
};

}  // namespace

bool has_conditional_nodes() {
  int version = 0;
  return cudaDriverGetVersion(&version) == cudaSuccess && version >= 13000;
}

void begin_conditional(const DeviceContext& context, const int64_t* value, CUstream_st* body) {
  cudaGraphNodeParams parameters{};
  parameters.type = cudaGraphNodeTypeConditional;
  parameters.conditional.type = cudaGraphCondTypeIf;
  parameters.conditional.size = 1;
  check_cuda(cudaGraphConditionalHandleCreate(&parameters.conditional.handle, Capture(context.stream).graph, 0, 0),
             "cudaGraphConditionalHandleCreate");
  launch_kernel(context, set_condition, 1, 1, parameters.conditional.handle, value);
  const Capture before(context.stream);
  cudaGraphNode_t node = nullptr;
  check_cuda(cudaGraphAddNode(&node, before.graph, before.nodes, before.edges, before.count, &parameters),
             "cudaGraphAddNode");
  check_cuda(cudaStreamUpdateCaptureDependencies(context.stream, &node, nullptr, 1, cudaStreamSetCaptureDependencies),
             "cudaStreamUpdateCaptureDependencies");
  check_cuda(cudaStreamBeginCaptureToGraph(body, parameters.conditional.phGraph_out[0], nullptr, nullptr, 0,
                                           cudaStreamCaptureModeThreadLocal),
             "cudaStreamBeginCaptureToGraph");
}

void end_conditional(CUstream_st* body) {
  cudaGraph_t graph = nullptr;
  check_cuda(cudaStreamEndCapture(body, &graph), "cudaStreamEndCapture");
}

#else

bool has_conditional_nodes() { return false; }

void begin_conditional(const DeviceContext&, const int64_t*, CUstream_st*) {
  throw std::runtime_error("conditional: built with a CUDA before 13");
}

void end_conditional(CUstream_st*) {}

#endif

}  // namespace pgccd
