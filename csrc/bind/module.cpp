// pgccd._C: importing it runs the registrations of this binary. Its functions act on the calling thread.
#include <Python.h>

#include <utility>

#include "bind/build_information.h"
#include "bind/thread_state.h"

namespace pgccd::bind {

int64_t& scratch_peak() {
  thread_local int64_t bytes = 0;
  return bytes;
}

int& device_share() {
  thread_local int share = 1;
  return share;
}

}  // namespace pgccd::bind

namespace {

PyObject* take_scratch_peak(PyObject*, PyObject*) {
  return PyLong_FromLongLong(std::exchange(pgccd::bind::scratch_peak(), 0));
}

PyObject* set_device_share(PyObject*, PyObject* given) {
  const long share = PyLong_AsLong(given);
  if (share == -1 && PyErr_Occurred() != nullptr) return nullptr;
  if (share < 1 || share > 1024) {
    PyErr_SetString(PyExc_ValueError, "share: expected a number from 1 to 1024");
    return nullptr;
  }
  return PyLong_FromLong(std::exchange(pgccd::bind::device_share(), static_cast<int>(share)));
}

PyObject* build_information(PyObject*, PyObject*) {
  PyObject* const out = PyDict_New();
  if (out == nullptr) return nullptr;
  for (const auto& [name, value] : pgccd::bind::build_information()) {
    PyObject* const text = PyUnicode_FromString(value);
    const bool is_set = text != nullptr && PyDict_SetItemString(out, name, text) == 0;
    Py_XDECREF(text);
    if (!is_set) {
      Py_DECREF(out);
      return nullptr;
    }
  }
  return out;
}

PyMethodDef methods[] = {
    {"build_information", build_information, METH_NOARGS,
     "Version, commit, digest of the C++ sources, compiler and CUDA of this build."},
    {"set_device_share", set_device_share, METH_O,
     "Lets operators called by this thread take 1 / share of a GPU's blocks. Returns the former share."},
    {"take_scratch_peak", take_scratch_peak, METH_NOARGS,
     "Most bytes of scratch memory that an operator on a GPU, called by this thread, has held since the last call."},
    {nullptr, nullptr, 0, nullptr}};

}  // namespace

PyMODINIT_FUNC PyInit__C() {
  static PyModuleDef definition = {
      PyModuleDef_HEAD_INIT, "_C", nullptr, -1, methods, nullptr, nullptr, nullptr, nullptr};
  return PyModule_Create(&definition);
}
